"""Every page in a real browser: light, dark and on a phone, without scripts, by keyboard, and with axe-core."""

from __future__ import annotations

import html
import re
import shutil
import threading
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from werkzeug.exceptions import HTTPException

from slamhive.base.settings import Mode
from slamhive.domain.accounts import Role
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.store.records import RunSort, SavedSearchRecord
from tests.services.test_trash import end
from tests.serving import serving
from tests.waiting import eventually
from tests.web import web_world as world
from tests.web.account_world import NAMES, PASSWORD, AccountWeb, account_web
from tests.web.browser_world import BROWSER, LOOKS, faultless, opened, violations, visit, wide_parts
from tests.web.test_web_claims import keep_claims
from tests.web.test_web_experiments import TRIAL

if TYPE_CHECKING:
    from flask.testing import FlaskClient
    from playwright.sync_api import Browser, CDPSession, Page

pytestmark = BROWSER

FIRST_VIEW_BYTES = 300_000
FEWEST_PAGES = 20
PLOTS = "[data-figure], [data-chart], [data-figures]"
INTERACTIVE_S = 1.0
"""CPU time until a page without plots can be used, drawing included."""
ANALYSIS = """\
name: All runs
select: {all: {where: "id >= 1"}}
forms:
- {form: distributions, metrics: [duration]}
- {form: table, metrics: [ate.rmse]}
"""
MORE = ("/runs/1", "/runs/3", "/runs/4", "/compare?runs=1,2")
"""Pages that differ from others with the same endpoint."""


@pytest.fixture(scope="module")
def furnished(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an installation with something behind every page."""
    folder = tmp_path_factory.mktemp("furnished")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    hive = world.make_hive(folder)
    end(hive, *world.add_runs(hive, 1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Executors, "choose", lambda _executors, asked=None: asked or "process")
        hive.experiments.start(ExperimentSource(TRIAL))
    hive.searches.save(SavedSearchRecord("good", "state = succeeded", ("duration",), RunSort("duration"), False))
    hive.stored_analyses.create(ANALYSIS)
    hive.analysis_jobs.work_once("tests", threading.Event())
    keep_claims(hive)
    hive.close()
    return folder


@pytest.fixture(scope="module")
def desk(furnished: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, AccountWeb]]:
    """The address of an installation whose callers sign in; no test may change it."""
    folder = tmp_path_factory.mktemp("desk")
    shutil.copytree(furnished, folder, symlinks=True, dirs_exist_ok=True)
    with account_web(folder) as accounts, serving(accounts.web.hive) as server:
        yield server, accounts


@pytest.fixture(scope="module")
def archive(furnished: Path) -> Iterator[str]:
    """The address of the same, view-only and open to everybody."""
    hive = world.make_hive(furnished, Mode.VIEW_ONLY)
    with serving(hive) as server:
        yield server
    hive.close()


@pytest.fixture(scope="module")
def own_hive(furnished: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hive]:
    """An installation that tests may change, as long as the others still find what they need."""
    folder = tmp_path_factory.mktemp("own")
    shutil.copytree(furnished, folder, symlinks=True, dirs_exist_ok=True)
    hive = world.make_hive(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Executors, "choose", lambda _executors, asked=None: asked or "process")
        yield hive
    hive.close()


@pytest.fixture(scope="module")
def own(own_hive: Hive) -> Iterator[str]:
    """Its address."""
    with serving(own_hive) as server:
        yield server


def addresses(client: FlaskClient) -> list[str]:
    """One address of each kind of page that links lead to from the dashboard, and ``MORE``."""
    adapter = client.application.url_map.bind("localhost")
    found: dict[str, str] = {}
    waiting = ["/"]
    while waiting:
        address = waiting.pop(0)
        path, _, query = address.partition("?")
        try:
            endpoint = adapter.match(path, query_args=query)[0]
        except HTTPException:
            continue
        if endpoint in found or endpoint == "static":
            continue
        answer = client.get(address)
        is_file = "attachment" in answer.headers.get("Content-Disposition", "")
        if answer.status_code == 200 and answer.mimetype == "text/html" and not is_file:
            found[endpoint] = address
            waiting += [html.unescape(link) for link in re.findall(r'href="(/[^"#]*)', answer.text)]
    return sorted({*found.values(), *MORE})


@pytest.fixture(scope="module")
def pages(desk: tuple[str, AccountWeb]) -> list[str]:
    """The pages that an admin comes to."""
    found = addresses(desk[1].of(Role.ADMIN))
    assert len(found) > FEWEST_PAGES
    return found


def told(faults: dict[str, list[str]]) -> None:
    """Fail with every fault of every page."""
    lines = [f"{address}: {fault}" for address, found in faults.items() for fault in found]
    assert not lines, "\n".join(lines)


def sign_in(page: Page, name: str) -> None:
    """Sign in with keys alone."""
    page.goto("/login")
    page.locator("#name").focus()
    page.keyboard.type(name)
    page.keyboard.press("Tab")
    page.keyboard.type(PASSWORD)
    with page.expect_navigation():
        page.keyboard.press("Enter")


def weight(page: Page) -> list[str]:
    """List what makes a page slow: bytes, without pictures that need scrolling, and plotly.js outside of reports."""
    sizes = page.evaluate(
        """() => {
            const below = [...document.images].filter((image) => image.getBoundingClientRect().top >= innerHeight);
            return Object.fromEntries(["navigation", "resource"].flatMap((kind) => performance.getEntriesByType(kind))
                .filter((entry) => !below.some((image) => image.src === entry.name))
                .map((entry) => [entry.name, entry.encodedBodySize]));
        }"""
    )
    plotly = [url for url in sizes if "plotly" in url]
    total = sum(size for url, size in sizes.items() if url not in plotly)
    found = [f"{total} bytes: {sizes}"] if total >= FIRST_VIEW_BYTES else []
    if plotly and not page.locator("[data-chart]").count():
        found.append("loads plotly.js, which only reports need")
    return found


def lacking_alternatives(page: Page) -> list[str]:
    """Plots without a name, or without the table that says the same."""
    script = """() => [...document.querySelectorAll(".js-plotly-plot, [data-drawn]")]
        .filter((plot) => !plot.ariaLabel || !plot.nextElementSibling?.matches("details.plot-table"))
        .map((plot) => plot.outerHTML.slice(0, 120))"""
    return [f"plot without a name and a table: {plot}" for plot in page.evaluate(script)]


def busy_s(session: CDPSession) -> float:
    """CPU time of the page's main thread since its process began, in s; the same on a busy machine."""
    metrics = session.send("Performance.getMetrics")["metrics"]
    return next(float(metric["value"]) for metric in metrics if metric["name"] == "TaskDuration")


@pytest.mark.parametrize(("look", "role"), [("light", Role.ADMIN), ("dark", Role.READER), ("phone", Role.MEMBER)])
def test_every_page_is_drawn_without_faults(
    chromium: Browser, desk: tuple[str, AccountWeb], pages: list[str], look: str, role: Role
) -> None:
    """Every page in every look and for every role. Other tests hold which pages are refused to whom."""
    seen: dict[str, list[str]] = defaultdict(list)
    refused = 0
    with opened(chromium, desk[0], look) as (page, faults):
        sign_in(page, NAMES[role])
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable", {"timeDomain": "threadTicks"})
        for address in pages:
            before_s = busy_s(session)
            status = visit(page, address)
            took_s = busy_s(session) - before_s
            if status == 403 and role is not Role.ADMIN:
                refused += 1
                faults.taken()
                continue
            light = not page.locator(PLOTS).count()
            seen[address] += [*faults.taken(), *wide_parts(page), *weight(page), *lacking_alternatives(page)]
            seen[address] += [f"status {status}"] if status != 200 else []
            seen[address] += [f"keeps a processor busy for {took_s:.2f} s"] if light and took_s > INTERACTIVE_S else []
            seen[address] += violations(page, look)
            faults.taken()
    told(seen)
    assert len(pages) - refused > FEWEST_PAGES


def test_every_page_of_an_archive_can_be_read_without_scripts(
    chromium: Browser, archive: str, pages: list[str]
) -> None:
    """View-only pages can be read without scripts."""
    seen: dict[str, list[str]] = defaultdict(list)
    refused = 0
    with opened(chromium, archive, java_script_enabled=False) as (page, faults):
        for address in pages:
            answer = page.goto(address, wait_until="load")
            assert answer is not None
            if answer.status in {403, 404}:
                refused += 1
                faults.taken()
                continue
            seen[address] += faults.taken()
            seen[address] += [f"status {answer.status}"] if answer.status != 200 else []
            if page.get_by_text("Loading …").locator("visible=true").count():
                seen[address].append("says Loading without scripts")
            if page.get_by_role("heading", level=1).count() != 1:
                seen[address].append("has no heading")
    told(seen)
    assert len(pages) - refused > FEWEST_PAGES


def test_the_keyboard_alone_leads_through_a_list(chromium: Browser, archive: str) -> None:
    with faultless(chromium, archive) as page:
        page.goto("/runs", wait_until="load")
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.textContent") == "Skip to content"
        page.keyboard.press("Enter")
        assert page.evaluate("document.activeElement.id") == "main"
        reached = set()
        for _ in range(80):
            page.keyboard.press("Tab")
            reached.add(page.evaluate("document.activeElement.getAttribute('href') || document.activeElement.name"))
        assert "/runs/1" in reached
        assert "where" in reached


def test_the_theme_is_kept(chromium: Browser, archive: str) -> None:
    with faultless(chromium, archive) as page:
        page.goto("/", wait_until="load")
        page.click("#theme")
        page.goto("/runs", wait_until="load")
        assert page.evaluate("document.documentElement.dataset.bsTheme") == "dark"


def test_a_plot_has_a_table_that_says_the_same(chromium: Browser, archive: str) -> None:
    with faultless(chromium, archive) as page:
        page.goto("/runs/1", wait_until="load")
        page.wait_for_selector("[data-figure=error][data-drawn]", timeout=60_000)
        table = page.locator("[data-figure=error] + details.plot-table")
        page.locator("[data-figure=error]").get_by_role("button", name="Table").press("Enter")
        table.locator("tbody tr").first.wait_for()
        assert table.locator("thead th").all_inner_texts()[:3] == [
            "Series",
            "Points",
            "lowest recording time [s]",
        ]
        cells = table.locator("tbody tr").first.locator("th, td").all_inner_texts()
        assert cells[:2] == ["eye-slam-stereo", "400"]
        assert float(cells[3]) == pytest.approx(39.9)


def test_a_failed_run_says_once_which_plots_are_missing(chromium: Browser, archive: str) -> None:
    with faultless(chromium, archive) as page:
        page.goto(f"/runs/{world.RUNS['failed']}#overview", wait_until="load")
        missing = page.locator("[data-no-plots]")
        missing.wait_for()
        assert "No plot of Trajectory: The run has left no trajectory that can be read." in missing.inner_text()
        assert "CPU over time, Memory over time: CPU and memory were not sampled." in missing.inner_text()
        assert page.locator("section.panel:has([data-figure]):visible").count() == 0


# -- journeys ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def browsing(chromium: Browser, own: str) -> Iterator[Page]:
    """A page on an installation that the test may change. Any fault on the way fails the test."""
    with faultless(chromium, own) as page:
        yield page


def press(page: Page, name: str) -> None:
    """Press a button that leads to another page."""
    with page.expect_navigation():
        page.get_by_role("button", name=name, exact=True).first.click()


def heading(page: Page) -> str:
    return str(page.locator("h1").inner_text())


def test_selected_runs_are_compared(browsing: Page) -> None:
    browsing.goto("/runs")
    compare = browsing.get_by_role("button", name="Compare")
    assert not compare.count(), "the actions come with a selection"
    browsing.get_by_label("Run 1", exact=True).check()
    assert browsing.locator("#why-not").inner_text() == "Select another run to compare."
    browsing.get_by_label("Run 2", exact=True).check()
    compare.click()
    browsing.wait_for_selector("[data-figure=path][data-drawn]", timeout=60_000)
    assert browsing.url.endswith("/compare?run=1&run=2") or "runs=1,2" in browsing.url


def test_a_filter_is_completed_while_typing(browsing: Page) -> None:
    browsing.goto("/runs")
    browsing.locator("#where").press_sequentially("sta")
    browsing.get_by_role("option", name="state", exact=False).first.wait_for()
    browsing.locator("#where").fill("state = failed")
    browsing.locator("#where").press("Enter")
    browsing.wait_for_url("**/runs?where=*")
    rows = browsing.locator("#list tbody tr")
    assert rows.count() == 1
    assert "Run 3" in str(rows.locator("input").get_attribute("aria-label"))


def test_a_deleted_run_comes_back(browsing: Page) -> None:
    browsing.goto("/runs")
    browsing.get_by_label("Run 6", exact=True).check()
    press(browsing, "Delete selected")
    assert heading(browsing) == "Delete 1 run?"
    press(browsing, "Move to the trash")
    assert browsing.get_by_label("Run 6", exact=True).count() == 0
    press(browsing, "Undo")
    browsing.goto("/runs")
    assert browsing.get_by_label("Run 6", exact=True).count() == 1


def test_runs_get_tags_and_a_note(browsing: Page) -> None:
    browsing.goto("/runs")
    browsing.get_by_label("Run 1", exact=True).check()
    press(browsing, "Tag selected")
    browsing.get_by_label("Tags to add").fill("paper, nice")
    press(browsing, "Store tags")
    browsing.goto("/runs/1")
    browsing.get_by_label("Note", exact=True).fill("best of all")
    with browsing.expect_navigation():
        browsing.locator("form", has=browsing.locator("#note")).get_by_role("button").first.click()
    browsing.goto("/runs?where=tag+%3D+paper")
    assert browsing.locator("#list tbody tr").count() == 1
    browsing.goto("/runs/1")
    assert browsing.get_by_label("Note", exact=True).input_value() == "best of all"


def test_a_run_is_started_from_the_form(browsing: Page) -> None:
    browsing.goto("/runs/new?algorithm=eye-slam-stereo&dataset=room")
    browsing.get_by_role("button", name="Start", exact=True).click()
    browsing.wait_for_url("**/runs/*")
    assert "queued" in browsing.locator("main").inner_text().lower()


def test_an_experiment_is_previewed_while_typing_and_started(browsing: Page) -> None:
    browsing.goto("/new-experiment")
    browsing.locator("#yaml").fill(TRIAL.replace("trial", "second"))
    browsing.locator("#preview").get_by_text("12").first.wait_for()
    browsing.get_by_role("button", name="Start", exact=True).click()
    browsing.wait_for_url("**/experiments/second")
    assert heading(browsing) == "Which of eye-slam-mono and eye-slam-stereo is most accurate on room?"


def test_a_ranking_follows_its_runs_and_configurations_are_compared(own_hive: Hive, browsing: Page) -> None:
    cells = own_hive.experiments.cells("trial", 0, 3).cells
    for run in (run for cell in cells[:2] for run in cell.runs):
        world.finish_run(own_hive, run.id)
        world.evaluate_run(own_hive, run.id, 0.1 + 0.01 * run.id)
    browsing.goto("/experiments/trial?by=configuration")
    ranking = browsing.locator("#ranking")
    assert "Preliminary: 4 of 12 runs have ended" in ranking.inner_text()
    assert ranking.locator("svg.lane circle:visible").count() == 4
    button = ranking.get_by_role("button", name="Compare")
    assert button.is_disabled()
    for box in ranking.locator("tbody input[name=run]").all():
        box.check()
    ranking.locator("h2").click()
    world.fail_run(own_hive, cells[2].runs[0].id)
    browsing.get_by_text("Preliminary: 5 of 12 runs have ended").wait_for()
    assert ranking.locator("svg.lane .cross").count() == 1
    assert ranking.locator("tbody input[name=run]:checked").count() == 2
    button.click()
    browsing.wait_for_url("**/compare?**group=configuration**")
    assert "4 runs" in browsing.locator("main").inner_text()


@pytest.mark.parametrize("address", ["/analyses/new", "/new-experiment"])
def test_the_yaml_fills_its_panel(chromium: Browser, own: str, address: str) -> None:
    for look in LOOKS:
        with opened(chromium, own, look) as (page, _):
            visit(page, f"{address}#yaml-part" if "analyses" in address else address)
            panel, text = (page.locator(part).bounding_box() for part in (".panel:has(#yaml)", "#yaml"))
            assert panel is not None
            assert text is not None
            assert text["width"] >= 0.8 * panel["width"], look


def test_a_plot_type_is_inserted_into_a_new_analysis(browsing: Page) -> None:
    browsing.goto("/analyses/new")
    browsing.get_by_role("button", name="Add Table of metrics").click()
    eventually(lambda: "form: table" in browsing.locator("#yaml").input_value(), "the insertion")
    assert browsing.url.endswith("/analyses/new"), "in place"
    browsing.get_by_role("link", name="YAML").click()
    browsing.locator("#yaml").fill("name: bad\nselect: {all: {where: 'id >= 1'}}\nforms: [{form: nope}]\n")
    browsing.locator("#verdict.bad", has_text="nope").wait_for()


def test_the_plots_of_a_text_are_edited(browsing: Page) -> None:
    browsing.goto("/analyses/new")
    plots, text = browsing.locator("#plots li"), browsing.locator("#yaml")
    before = plots.count()
    browsing.get_by_role("link", name="YAML").click()
    text.fill(text.input_value().rstrip() + "\n  - {form: scatter, x: ate.rmse, y: cpu.mean}\n")
    eventually(lambda: plots.count() == before + 1, "the plot in the list")
    browsing.get_by_role("link", name="Report", exact=True).click()
    plots.last.get_by_role("button", name="Edit").click()
    browsing.locator('[name="scatter.y"]').select_option("rpe.rmse")
    browsing.get_by_role("button", name=f"Replace plot {before + 1}").click()
    eventually(lambda: "rpe.rmse" in text.input_value(), "the other metric")
    plots.last.get_by_role("button", name="Up").click()
    eventually(lambda: "rpe.rmse" not in plots.last.inner_text(), "the other order")
    plots.nth(before - 1).get_by_role("button", name="Remove").click()
    eventually(lambda: "rpe.rmse" not in text.input_value(), "the text without the plot")
    assert plots.count() == before


def test_previews_follow_a_valid_text(browsing: Page) -> None:
    browsing.goto("/analyses/new#yaml-part")
    pictures = browsing.locator("#plots img")
    pictures.first.wait_for(timeout=60_000, state="attached")
    before = pictures.count()
    assert pictures.first.evaluate("image => image.naturalWidth") > 200
    text = browsing.locator("#yaml").input_value()
    browsing.locator("#yaml").fill(text.rstrip() + "\n  - {form: scatter, x: ate.rmse, y: nope}\n")
    browsing.locator("#verdict.bad", has_text="nope").wait_for()
    assert pictures.count() == before, "a text that is not valid keeps the pictures that it had"
    browsing.locator("#yaml").fill(text.rstrip() + "\n  - {form: scatter, x: ate.rmse, y: cpu.mean}\n")
    browsing.get_by_alt_text("Preview of Scatter").wait_for(timeout=60_000, state="attached")
    assert pictures.count() == before + 1


def test_a_search_is_saved_and_used(browsing: Page) -> None:
    browsing.goto("/runs?where=state+%3D+succeeded")
    rows = browsing.locator("#list tbody tr")
    found = rows.count()
    assert found >= 3
    browsing.get_by_text("Saved searches", exact=True).click()
    browsing.get_by_label("Name of the search").fill("fine")
    press(browsing, "Save this search")
    browsing.goto("/runs")
    assert rows.count() > found
    with browsing.expect_navigation():
        browsing.get_by_role("link", name="fine", exact=True).first.click()
    assert rows.count() == found


def test_a_queued_run_is_cancelled_and_retried(browsing: Page) -> None:
    browsing.goto("/runs/5")
    press(browsing, "Cancel")
    assert "cancelled" in browsing.locator("main").inner_text().lower()
    press(browsing, "Retry")
    assert int(browsing.url.rpartition("/")[2]) > 18


SAID = """() => {
    window.said = [];
    new MutationObserver((changes) => window.said.push(...changes.map(({ target }) => target.textContent)))
        .observe(document.body, { childList: true, subtree: true, characterData: true });
}"""
"""Remembers what a page says for a moment, which a busy machine may miss."""


def copied(page: Page, kind: str) -> list[str]:
    page.evaluate(SAID)
    page.locator("#list").get_by_role("button", name=kind).click()
    eventually(lambda: page.evaluate("window.said.some((text) => text.includes('Copied'))"), "the copy")
    return str(page.evaluate("navigator.clipboard.readText()")).splitlines()


def test_tables_are_copied_as_csv_markdown_and_latex(browsing: Page) -> None:
    browsing.context.grant_permissions(["clipboard-read", "clipboard-write"])
    browsing.goto("/runs?columns=id,algorithm,ate.rmse,cpu.mean&sort=id&order=asc")
    assert copied(browsing, "CSV")[:2] == [
        "Run,Algorithm,ATE RMSE [m],CPU mean [cores]",
        "1,eye-slam-stereo,0.04567,1.25",
    ]
    head, line, first, *_ = copied(browsing, "Markdown")
    assert line == "| ---: | --- | ---: | ---: |"
    assert first == "| 1 | eye-slam-stereo | 0.0457 | 1.25 |"
    latex = copied(browsing, "LaTeX")
    begin = latex.index("\\begin{tabular}{rlrr}")
    assert latex[0] == "% \\usepackage{booktabs}"
    assert latex[begin + 1] == "\\toprule"
    assert latex[begin + 4] == "1 & eye-slam-stereo & 0.0457 & 1.25 \\\\"
    assert head.count("|") == 5
    browsing.goto("/runs?group=configuration&where=id = 1&columns=id,algorithm,ate.rmse")
    (row,) = (line for line in copied(browsing, "LaTeX") if "eye-slam-stereo" in line)
    assert re.search(r" & 1 of [2-9] & ", row), "a part of a group says so in a paper too"


def test_the_keys_lead_everywhere(browsing: Page) -> None:
    browsing.goto("/")
    browsing.keyboard.press("?")
    assert browsing.locator("#keys").is_visible()
    browsing.keyboard.press("Escape")
    browsing.keyboard.press("g")
    browsing.keyboard.press("r")
    browsing.wait_for_url("**/runs")
    browsing.keyboard.press("/")
    browsing.keyboard.type("eye-slam-mono")
    browsing.keyboard.press("Enter")
    browsing.wait_for_url("**/algorithms/eye-slam-mono")


def test_the_palette_presses_the_buttons_of_a_page_and_finds_by_any_word(browsing: Page) -> None:
    browsing.goto("/runs/1")
    browsing.keyboard.press("Control+k")
    browsing.keyboard.type("compare")
    browsing.keyboard.press("Enter")
    browsing.wait_for_url("**/compare?**")
    browsing.keyboard.press("/")
    browsing.keyboard.type("mono ulgh")
    option = browsing.get_by_role("option", name="Find “mono ulgh” everywhere")
    option.click()
    browsing.wait_for_url("**/find?q=mono**")
    assert "Nothing is called" in browsing.locator("main").inner_text()


@pytest.mark.parametrize("scripts", [True, False])
def test_the_rail_is_a_drawer_on_a_phone_with_and_without_scripts(
    chromium: Browser, archive: str, scripts: bool
) -> None:
    with faultless(chromium, archive, look="phone", java_script_enabled=scripts) as page:
        page.goto("/")
        rail = page.get_by_role("navigation", name="Main")
        assert not rail.is_visible()
        page.get_by_role("button", name="Menu").click()
        rail.get_by_role("link", name="Datasets").click()
        assert page.url.endswith("/datasets")
        assert not rail.get_by_role("link", name="Machines").count(), "visitors see no machines"


def test_a_click_on_a_peak_shows_what_the_sensors_saw(browsing: Page) -> None:
    browsing.goto("/runs/1")
    browsing.wait_for_selector("[data-figure=error][data-drawn]", timeout=60_000)
    panel = browsing.locator("[data-moment]")
    browsing.evaluate("document.dispatchEvent(new CustomEvent('moment', { detail: 1005.0 }))")
    panel.get_by_text("The frame took 30.0 ms.").wait_for()
    assert panel.locator("figcaption").count() == 2
    for plot in ("error", "latency", "path"):
        assert float(str(browsing.locator(f"[data-figure={plot}]").get_attribute("data-moment"))) == pytest.approx(5.0)


def test_the_axis_of_a_plot_can_be_logarithmic(browsing: Page) -> None:
    browsing.goto("/runs/1")
    plot = browsing.locator("[data-figure=error]")
    browsing.wait_for_selector("[data-figure=error][data-drawn=linear]", timeout=60_000)
    assert not browsing.locator("[data-figure=path]").get_by_role("button", name="Log").count(), "metres on both axes"
    for kind in ("log", "linear", "log"):
        plot.get_by_role("button", name="Log").click()
        browsing.wait_for_selector(f"[data-figure=error][data-drawn={kind}]")
    assert plot.get_by_role("button", name="Log").get_attribute("aria-pressed") == "true"
    browsing.evaluate("document.dispatchEvent(new Event('themechange'))")
    assert plot.get_attribute("data-drawn") == "log"


def test_runs_are_exported(browsing: Page) -> None:
    browsing.goto("/runs")
    browsing.locator("summary", has_text="Export").click()
    with browsing.expect_download() as download:
        browsing.get_by_role("link", name="CSV", exact=True).first.click()
    lines = download.value.path().read_text().splitlines()
    assert len(lines) > 5
    assert "algorithm" in lines[0]
