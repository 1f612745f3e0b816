"""Journeys of a user, on a wide and on a small screen, with the clicks that each takes."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from slamhive.base.settings import Mode
from slamhive.services import demo
from slamhive.services.hive import Hive
from slamhive.web.static_site import SiteRequest, StaticSite
from tests.serving import serving
from tests.waiting import eventually
from tests.web import web_world as world
from tests.web.account_world import PASSWORD, account_web
from tests.web.browser_world import BROWSER, faultless
from tests.web.journey_world import (
    DEMO_S,
    SIZES,
    WORST_S,
    Walk,
    furnish,
    furnish_nothing,
    known_clicks,
    worker_beside,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = BROWSER

Journey = Callable[[str, str], AbstractContextManager[Walk]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the installation lies."""
    return tmp_path_factory.mktemp("journeys")


@pytest.fixture(scope="module")
def hive(folder: Path, sqlite_template: Path) -> Iterator[Hive]:
    """The installation of all journeys."""
    hive = furnish(folder, sqlite_template)
    yield hive
    hive.close()


@pytest.fixture(scope="module")
def server(hive: Hive) -> Iterator[str]:
    """Its address, with a worker beside the server."""
    with worker_beside(hive), serving(hive) as address:
        yield address


@pytest.fixture(params=SIZES)
def journey(chromium: Browser, request: pytest.FixtureRequest) -> Journey:
    """Begins a journey, and compares its clicks with those of the documentation."""
    name = request.node.originalname.removeprefix("test_").replace("_", " ")

    @contextmanager
    def begin(server: str, first: str) -> Iterator[Walk]:
        size = SIZES[request.param]
        with faultless(chromium, server, color_scheme="light", **size) as page:
            page.context.grant_permissions(["clipboard-read", "clipboard-write"])
            page.goto(first, wait_until="load")
            walk = Walk(page)
            yield walk
            walk.look()
        assert walk.wide == []
        known = dict(zip(SIZES, known_clicks().get(name, (0, 0)), strict=True))
        assert walk.clicks == known[request.param], (
            f"{walk.clicks} clicks at {request.param}; docs/page-style.md says {known}"
        )

    return begin


def heading(page: Page) -> str:
    return str(page.locator("h1").inner_text())


def drawn(page: Page, plot: str) -> None:
    """Wait for a plot of a server's page."""
    page.wait_for_selector(f"[data-figure={plot}][data-drawn]", timeout=60_000)


@pytest.fixture
def nothing(tmp_path: Path, sqlite_template: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of an installation without data, with a worker beside the server."""
    monkeypatch.setattr(demo, "SECONDS", DEMO_S)
    hive = furnish_nothing(tmp_path, sqlite_template)
    with worker_beside(hive), serving(hive) as address:
        yield address
    hive.close()


def test_empty_installation_to_the_first_answer(journey: Journey, nothing: str) -> None:
    """One button runs the demo and shows its progress; the answer comes by itself."""
    with journey(nothing, "/") as walk:
        page = walk.page
        walk.click(walk.button("Run the demo"))
        page.get_by_role("progressbar", name="Progress of the demo").or_(page.locator("#answers")).first.wait_for()
        page.locator("#answers", has_text="room-demo").wait_for(timeout=300_000)
        walk.click(page.locator("#answers").get_by_role("link", name=re.compile("room-demo")).first)
        page.locator("#head", has_text="tiny: ATE").wait_for(timeout=90_000)
        assert "not comparable" not in page.locator("main").inner_text()


def test_first_look(journey: Journey, server: str) -> None:
    """From the first page to the path of the best run."""
    with journey(server, "/") as walk:
        page = walk.page
        assert "eyes" in page.locator("#answers").inner_text()
        walk.click(walk.link("eyes"))
        assert heading(page) == "Do two eyes see better than one?"
        ranking = page.get_by_role("region", name="Table: Ranking on room")
        assert ranking.evaluate("part => part.scrollWidth - part.clientWidth") == 0, "the ranking scrolls sideways"
        walk.click(page.locator("#ranking tbody tr").first.locator("svg.lane a circle.on-light").last)
        drawn(page, "path")
        assert heading(page).endswith("good")


def test_start_watch_and_read_a_run(journey: Journey, server: str, hive: Hive) -> None:
    with journey(server, "/") as walk:
        page = walk.page
        walk.new("Run")
        walk.choose(page.get_by_label("Algorithm", exact=True), "tiny", leads=True)
        walk.choose(page.get_by_label("Dataset", exact=True), "track", leads=True)
        walk.click(walk.button("Start"))
        page.wait_for_url("**/runs/*")
        page.locator("h1", has_text="good").wait_for(timeout=90_000)
        page.locator(".tiles", has_text="ATE").wait_for(timeout=90_000)
        drawn(page, "error")
        walk.click(walk.link("Log and files"))
        assert "tiny says hello" in page.locator("#log").inner_text()


def test_which_is_best_and_is_it_real(journey: Journey, server: str) -> None:
    with journey(server, "/") as walk:
        page = walk.page
        walk.click(walk.link("eyes"))
        answer = page.locator("#head").inner_text()
        assert "eye-slam-stereo" in answer
        assert "p " in answer
        assert page.locator("#ranking tbody tr").count() == 2


def test_why_is_one_worse(journey: Journey, server: str) -> None:
    """From the recent runs to the moment at which one is far off, and what happened there."""
    with journey(server, "/") as walk:
        page = walk.page
        walk.click(page.locator("#results").get_by_role("link", name="12", exact=True))
        walk.click(walk.link("Compare with its repeats"))
        walk.click(page.get_by_role("link", name=re.compile("Run 12 is worse than run 10")))
        drawn(page, "error")
        eventually(lambda: page.locator("[data-figure=error]").get_attribute("data-moment"), "the moment")
        at_s = float(page.locator("[data-figure=error]").get_attribute("data-moment") or 0)
        assert WORST_S[0] <= at_s <= WORST_S[1]
        values = page.locator("[data-figure=error] .plot-values")
        eventually(lambda: values.locator(".value").count() == 3, "the errors of all runs")
        assert values.evaluate("part => part.scrollWidth - part.clientWidth") == 0, "values are cut off"


def test_filter_group_save_and_copy_as_LaTeX(journey: Journey, server: str) -> None:
    with journey(server, "/") as walk:
        page = walk.page
        walk.section("Runs")
        walk.enter(page.locator("#where"), "algorithm ~ eye-*")
        walk.click(walk.link("Group by configuration"))
        walk.click(page.locator("summary", has_text="Saved searches"))
        walk.enter(page.get_by_label("Name of the search"), f"eyes-{walk.width_px}")
        walk.click(page.locator("#list").get_by_role("button", name="LaTeX"))
        eventually(lambda: "toprule" in page.evaluate("navigator.clipboard.readText()"), "the copy")
        text = page.evaluate("navigator.clipboard.readText()")
        assert r"$0.0573 \pm 0.0110$" in text
        assert "SE(3)" in text.partition("\\caption{")[2].partition("\n")[0]


def test_heat_map_share_and_print(journey: Journey, server: str) -> None:
    with journey(server, "/") as walk:
        page = walk.page
        walk.click(walk.link("eyes"))
        walk.click(walk.link("Grid"))
        walk.choose(page.get_by_label("Shows"), "ate.rmse", leads=True)
        page.locator("table.cells.heat").wait_for()
        walk.click(walk.link("Make a report"))
        plots = page.locator("#plots li")
        before = plots.count()
        walk.click(walk.button("Add Scatter"))
        eventually(lambda: plots.count() == before + 1, "the plot in the report")
        walk.click(walk.button("Compute"))
        page.locator("#ready").wait_for(state="attached", timeout=90_000)
        page.wait_for_load_state("load")  # the mark comes before the figures
        page.emulate_media(media="print")
        breaks = "[...document.querySelectorAll('figure')].map((part) => getComputedStyle(part).breakInside)"
        assert set(page.evaluate(breaks)) == {"avoid"}, "no plot is on two pages"
        page.emulate_media(media="screen")
        walk.click(walk.button("Copy link"))
        eventually(lambda: page.evaluate("navigator.clipboard.readText()") == page.url, "the copy")


def test_import_by_the_web(journey: Journey, server: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.txt"
    np.savetxt(file, world.loop_path(noise_m=0.02))
    with journey(server, "/") as walk:
        page = walk.page
        walk.new("Import")
        walk.give(page.get_by_label("Files, one for each repeat"), file)
        walk.type(page.get_by_label("Algorithm", exact=True), "my-slam")
        walk.choose(page.locator("[name=dataset]"), "room")
        walk.click(walk.button("Look at the files"))
        assert "my-slam on room" in heading(page), page.locator("main").inner_text()
        walk.click(page.locator("main").get_by_role("button", name=re.compile("Store|Import")).first)
        page.get_by_text("my-slam").first.wait_for()


@pytest.fixture(scope="module")
def archive(server: str, folder: Path) -> Iterator[str]:
    """The address of the same runs on a view-only server."""
    hive = world.make_hive(folder, Mode.VIEW_ONLY)
    with serving(hive) as address:
        yield address
    hive.close()


def test_visitor_of_an_archive(journey: Journey, archive: str) -> None:
    with journey(archive, "/") as walk:
        page = walk.page
        assert "How to cite" in page.locator("main").inner_text()
        walk.click(walk.link("eyes"))
        walk.click(page.locator("#ranking tbody tr").first.locator("svg.lane a circle.on-light").last)
        drawn(page, "path")
        assert not page.get_by_role("button", name="Retry").count()


@pytest.fixture(scope="module")
def accounts(hive: Hive, server: str, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a copy whose callers sign in."""
    copy = tmp_path_factory.mktemp("accounts") / "copy"
    shutil.copytree(folder, copy, symlinks=True)
    with account_web(copy) as accounts, serving(accounts.web.hive) as address:
        yield address


def test_accounts(journey: Journey, accounts: str) -> None:
    """An admin adds and disables accounts; the new one signs in and makes a token."""
    with journey(accounts, "/login") as walk:
        page, name = walk.page, f"eve{walk.width_px}"
        sign_in(walk, "ada", PASSWORD)
        walk.click(page.locator("summary", has_text="ada"))
        walk.click(walk.link("Accounts roles, passwords"))
        walk.enter(page.get_by_label("Name"), name)
        password = page.get_by_role("status", name="New password").locator("code").inner_text()
        walk.click(walk.button("Disable rita") if "1440" in name else walk.button("Enable rita"))
        walk.click(page.locator("summary", has_text="ada"))
        walk.click(walk.button("Sign out"))
        sign_in(walk, name, password)
        walk.click(page.locator("summary", has_text=name))
        walk.click(walk.link("Your account password, tokens"))
        walk.enter(page.get_by_label("Name of the new token"), "laptop")
        made = page.get_by_role("status", name="New API token")
        walk.click(made.get_by_role("button", name="Copy"))
        token = made.locator("code").inner_text()
        eventually(lambda: page.evaluate("navigator.clipboard.readText()") == token, "the copy")


def sign_in(walk: Walk, name: str, password: str) -> None:
    """Sign in on the page for it, and come to the page that was wanted."""
    walk.look()  # a page that still loads has no field yet
    if not walk.page.locator("#name").count():
        walk.click(walk.link("Sign in"))
    walk.page.locator("#name").fill(name)
    walk.enter(walk.page.locator("#password"), password)


@pytest.fixture(scope="module")
def site(hive: Hive, server: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The address of a site of plain files."""
    folder = tmp_path_factory.mktemp("site") / "site"
    StaticSite(hive, SiteRequest(folder, title="Eyes")).write(lambda _done, _total: None)
    return folder.as_uri()


def test_static_site_from_a_folder(journey: Journey, site: str) -> None:
    """From the list to a comparison of two runs, and to the page of one."""
    with journey(site, f"{site}/index.html") as walk:
        page = walk.page
        walk.type(page.get_by_label("Search"), "ate.rmse<0.1")
        walk.click(page.get_by_label("Run 11", exact=True))
        walk.click(page.get_by_label("Run 12", exact=True))
        walk.click(walk.button("Compare"))
        page.locator("tr", has_text="ATE RMSE").first.wait_for()
        walk.click(walk.link("Run 12"))
        assert heading(page).startswith("Run 12")
