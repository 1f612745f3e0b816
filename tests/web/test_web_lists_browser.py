"""The list of runs in a real browser: columns move, stay pinned and keep their widths; a brush filters a table."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from slamhive.web.columns import DEFAULT_COLUMNS
from tests.serving import serving
from tests.waiting import eventually
from tests.web import web_world as world
from tests.web.browser_world import BROWSER, LOOKS, faultless, opened, violations, wide_parts
from tests.web.web_world import Web, make_web

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = BROWSER

PARALLEL = 'name: Lines\nselect: {all: {where: "id >= 1"}}\nforms:\n- {form: parallel, metric: cpu.mean}\n'
REFUSED = "console: Failed to load resource: the server responded with a status of 400 (BAD REQUEST)"


@pytest.fixture(scope="module")
def desk(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Web]:
    """Ten runs of three configurations, and an analysis of them."""
    folder = tmp_path_factory.mktemp("lists")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    hive = world.make_hive(folder)
    for place in range(5):
        (run_id,) = world.add_runs(hive, 1, nFeatures=1000 + 500 * (place % 2))
        world.finish_run(hive, run_id, {"cpu.mean": 1.0 + place, "ram.max": 3e8})
        world.evaluate_run(hive, run_id)
    hive.stored_analyses.create(PARALLEL)
    hive.analysis_jobs.work_once("tests", threading.Event())
    web = make_web(hive)
    yield web
    web.hive.close()


@pytest.fixture(scope="module")
def server(desk: Web) -> Iterator[str]:
    """The address of the installation."""
    with serving(desk.hive) as address:
        yield address


@pytest.fixture
def browsing(chromium: Browser, server: str) -> Iterator[Page]:
    """A page; fails if a script fails or the page asks another server."""
    with faultless(chromium, server) as page:
        yield page


def headings(page: Page) -> list[str]:
    return list(
        page.evaluate("[...document.querySelectorAll('#list th[data-column]')].map((head) => head.dataset.column)")
    )


def left_of(page: Page, column: str) -> float:
    box = page.locator(f"#list th[data-column='{column}']").bounding_box()
    assert box is not None
    return float(box["x"])


def test_columns_are_moved_by_dragging_and_by_keyboard_and_stay_so(browsing: Page) -> None:
    browsing.goto("/runs?columns=id,algorithm,dataset,state,ate.rmse")
    heading = browsing.locator("#list th[data-column='ate.rmse']")
    with browsing.expect_navigation():
        heading.drag_to(browsing.locator("#list th[data-column='algorithm']"), target_position={"x": 4, "y": 8})
    assert headings(browsing) == ["id", "ate.rmse", "algorithm", "dataset", "state"]
    browsing.locator("#columns > summary").press("Enter")
    for _ in range(2):
        with browsing.expect_navigation():
            browsing.locator("#left-state").press("Enter")
        eventually(lambda: browsing.evaluate("document.activeElement.id") == "left-state", "the focus")
    assert headings(browsing) == ["id", "ate.rmse", "state", "algorithm", "dataset"]
    assert "open=" not in browsing.url
    browsing.goto("/runs?where=state+%3D+succeeded")
    browsing.wait_for_url("**columns=*")
    assert headings(browsing) == ["id", "ate.rmse", "state", "algorithm", "dataset"]
    browsing.goto("/runs?columns=id,seed")
    assert headings(browsing) == ["id", "seed"]
    browsing.locator("#columns > summary").click()
    browsing.get_by_role("link", name="Standard columns").click()
    browsing.goto("/runs")
    assert headings(browsing) == list(DEFAULT_COLUMNS)


def test_columns_are_found_by_name(browsing: Page) -> None:
    browsing.goto("/runs?columns=id,state")
    browsing.locator("#columns > summary").click()
    groups = browsing.locator("#columns details.choices:visible")
    assert groups.count() > 5
    field = browsing.get_by_label("Find a column")
    field.fill("no such column")
    assert groups.count() == 0
    assert browsing.get_by_text("No column has this name").is_visible()
    field.fill("rmse absolute")
    assert groups.count() == 1
    field.press("Enter")
    browsing.locator("#columns input[value='ate.rmse']").check()
    field.fill("nfeatures")
    browsing.locator("#columns input[value='nFeatures']").check()
    assert browsing.locator("#columns input[value='ate.rmse']").is_visible()
    with browsing.expect_navigation():
        browsing.get_by_role("button", name="Apply").click()
    assert headings(browsing) == ["id", "state", "ate.rmse", "nFeatures"]


def test_a_kept_column_that_no_longer_exists_locks_nobody_out(chromium: Browser, server: str) -> None:
    with opened(chromium, server) as (page, _):
        page.goto("/healthz")
        page.evaluate(
            "localStorage.setItem('runs.layout.', JSON.stringify({ columns: 'id,gone', widths: { id: 99 } }))"
        )
        page.goto("/runs")
        eventually(lambda: "gone" in page.locator("main").inner_text(), "the error")
        page.goto("/runs")
        kept = "JSON.stringify(JSON.parse(localStorage.getItem('runs.layout.')))"
        eventually(lambda: page.evaluate(kept) == '{"widths":{"id":99}}', "the repair")
        assert headings(page) == list(DEFAULT_COLUMNS)


def test_pinned_columns_stay_and_widths_are_kept(browsing: Page) -> None:
    many = (
        "id,algorithm,dataset,state,parameters,created_at,ate.rmse,ate.mean,ate.max,rpe.rmse,cpu.mean,ram.max,duration"
    )
    browsing.set_viewport_size({"width": 900, "height": 700})
    browsing.goto(f"/runs?columns={many}&pinned=2&colours=yes&sparks=yes")
    before = [left_of(browsing, name) for name in ("id", "algorithm", "dataset")]
    browsing.evaluate("document.querySelector('#list .table-wrap').scrollLeft = 300")
    after = [left_of(browsing, name) for name in ("id", "algorithm", "dataset")]
    assert after[:2] == pytest.approx(before[:2], abs=1)
    assert after[2] == pytest.approx(before[2] - 300, abs=1)
    browsing.locator("#columns > summary").click()
    browsing.get_by_label("Width of Algorithm in pixels").fill("61")
    browsing.get_by_label("Width of Algorithm in pixels").press("Tab")
    browsing.reload()
    width = browsing.locator("#list th[data-column='algorithm']").bounding_box()
    assert width is not None
    assert width["width"] == pytest.approx(61, abs=1)
    browsing.evaluate("scrollTo(0, 0)")
    grip = browsing.locator("#list th[data-column='algorithm'] .grip").bounding_box()
    assert grip is not None
    browsing.mouse.move(grip["x"] + 3, grip["y"] + 8)
    browsing.mouse.down()
    browsing.mouse.move(grip["x"] + 43, grip["y"] + 8)
    browsing.mouse.up()
    width = browsing.locator("#list th[data-column='algorithm']").bounding_box()
    assert width is not None
    assert width["width"] == pytest.approx(101, abs=2)


def test_all_runs_of_the_table_are_selected_and_exported(browsing: Page) -> None:
    browsing.goto("/runs?columns=id,cpu.mean")
    browsing.get_by_label("Select all runs of this table").check()
    ended = browsing.locator("#list input[name=run]:enabled").count()
    assert browsing.locator("#list input[name=run]:checked").count() == ended == 8
    with browsing.expect_download() as download:
        browsing.get_by_role("button", name="Export selected").click()
    lines = download.value.path().read_text().splitlines()
    assert len(lines) == 1 + ended
    assert lines[0].startswith("id,")


def test_brushing_filters_the_table_beside(browsing: Page, desk: Web) -> None:
    (analysis,) = desk.hive.stored_analyses.listed()
    browsing.goto(f"/analyses/{analysis.token}")
    part = browsing.locator(".brushed")
    part.wait_for(timeout=60_000)
    assert part.locator("tbody tr").count() == 6  # the runs that are evaluated
    axis = browsing.locator(".js-plotly-plot .axis-brush .background").last
    axis.scroll_into_view_if_needed()
    box = axis.bounding_box()
    assert box is not None
    middle = box["x"] + box["width"] / 2
    browsing.mouse.move(middle, box["y"] + 0.02 * box["height"])
    browsing.mouse.down()
    browsing.mouse.move(middle, box["y"] + 0.6 * box["height"], steps=8)
    browsing.mouse.up()
    eventually(lambda: 0 < part.locator("tbody tr").count() < 6, "the brush")
    values = [float(text) for text in part.locator("tbody td:last-child").all_inner_texts()]
    assert min(values) > 2
    shown = part.locator("tbody td:first-child").all_inner_texts()
    part.get_by_role("link", name="Show them in the list of runs").click()
    browsing.locator("#list").wait_for()
    assert sorted(browsing.locator("#list tbody td.number:nth-child(2)").all_inner_texts()) == sorted(shown)


def test_a_row_is_looked_at_beside_the_list_and_the_actions_come_with_a_selection(browsing: Page) -> None:
    browsing.goto("/runs?where=state+%3D+succeeded&sort=id&order=asc")
    rows, aside, bar = (
        browsing.locator("#list tr[data-peek]"),
        browsing.locator("#peek"),
        browsing.locator(".actionbar"),
    )
    assert aside.is_hidden()
    assert bar.is_hidden()
    rows.first.locator("td").nth(5).click()
    first = rows.first.locator("a").first.inner_text()
    aside.get_by_role("heading", name=f"Run {first}").wait_for()
    browsing.keyboard.press("ArrowDown")
    second = rows.nth(1).locator("a").first.inner_text()
    aside.get_by_role("heading", name=f"Run {second}").wait_for()
    rows.first.locator("input").check()
    assert bar.get_by_text("1 selected").is_visible()
    browsing.keyboard.press("Escape")
    rows.nth(2).locator("td").nth(5).click()
    aside.get_by_role("button", name="Close").click()
    assert aside.is_hidden()
    assert wide_parts(browsing) == []


def test_heads_stay_and_the_error_is_in_sight_of_a_desk_also_in_groups(chromium: Browser, server: str) -> None:
    """The rhythm of the page too: titles of 24 to 28 px, numerals of one width, a ring around what has the focus."""
    style = "(part, name) => getComputedStyle(part)[name]"
    with faultless(chromium, server, viewport={"width": 1440, "height": 900}) as page:
        for address in ("/runs", "/runs?group=configuration"):
            page.goto(address)
            table = page.locator("#list table")
            assert table.locator("thead th").first.evaluate(style, "position") == "sticky"
            assert table.locator("tbody tr").first.locator("td, th").first.evaluate(style, "position") == "sticky"
            assert 24 <= float(page.locator("h1").evaluate(style, "fontSize").removesuffix("px")) <= 28
            number = table.locator("tbody td.number").first
            assert "tabular-nums" in number.evaluate(style, "fontVariantNumeric")
            error = page.locator("#list th[data-column='ate.rmse']").bounding_box()
            assert error is not None
            assert error["x"] + error["width"] < 1440
            assert wide_parts(page) == []
        page.goto("/runs/1")
        page.keyboard.press("Tab")
        assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
        trail = page.get_by_role("navigation", name="Breadcrumb")
        assert trail.locator("li").all_inner_texts() == ["Runs", "Run 1"]


def test_notes_and_tags_are_edited_in_the_list_by_keyboard(browsing: Page, desk: Web) -> None:
    run_id = desk.runs["done"]
    browsing.goto(f"/runs?columns=id,tags,note&where=id+%3D+{run_id}")
    browsing.locator("a[data-edit=tags]").press("Enter")
    field = browsing.get_by_label(f"Tags of run {run_id}")
    field.fill("paper best")
    field.press("Enter")
    browsing.get_by_text("best, paper").wait_for()
    assert browsing.evaluate("document.activeElement.dataset.edit") == "tags"
    browsing.locator("a[data-edit=note]").click()
    note = browsing.get_by_label(f"Note of run {run_id}")
    note.fill("left")
    note.press("Escape")
    assert browsing.locator(".cell-editor").count() == 0
    browsing.locator("a[data-edit=note]").click()
    note.fill("lost at <b>40 s</b>")
    note.press("Enter")
    browsing.get_by_text("lost at <b>40 s</b>").wait_for()
    stored = desk.hive.runs.get(run_id)
    assert (stored.tags, stored.note) == (("best", "paper"), "lost at <b>40 s</b>")


def test_a_tag_that_is_refused_stays_in_its_field_with_the_reason(chromium: Browser, server: str, desk: Web) -> None:
    with faultless(chromium, server, REFUSED) as page:
        page.goto(f"/runs?columns=id,tags&where=id+%3D+{desk.runs['bare']}")
        page.locator("a[data-edit=tags]").press("Enter")
        field = page.get_by_label(f"Tags of run {desk.runs['bare']}")
        field.fill("-x")
        field.press("Enter")
        page.get_by_role("alert").get_by_text("'-x' is not a tag").wait_for()
        assert field.input_value() == "-x"
        assert page.evaluate("document.activeElement.tagName") == "INPUT"


@pytest.mark.parametrize("look", LOOKS)
def test_the_furnished_list_has_no_faults(chromium: Browser, server: str, look: str) -> None:
    with opened(chromium, server, look) as (page, faults):
        for address in (
            "/runs?colours=yes&sparks=yes&pinned=1&open=columns",
            "/runs?group=configuration&colours=yes&sparks=yes",
        ):
            page.goto(address)
            faults.found += [f"{address}: {fault}" for fault in (*wide_parts(page), *violations(page, look))]
    assert faults.found == []
