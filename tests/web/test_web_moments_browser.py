"""One moment on the pages of a run and of a comparison, and what their first view weighs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.serving import serving
from tests.waiting import eventually
from tests.web import web_world as world
from tests.web.browser_world import BROWSER, LOOKS, faultless, opened, visit, wide_parts
from tests.web.web_world import Web

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser, Page

pytestmark = BROWSER

FIRST_VIEW_BYTES = 350_000
"""Of a page with plots and all that it loads by itself, until a 3D view is opened."""


@pytest.fixture
def server(web: Web) -> Iterator[str]:
    """An installation of two evaluated runs; the second is far off from 10 to 12 s."""
    (run,) = world.add_runs(web.hive, 1)
    world.finish_run(web.hive, run)
    world.evaluate_run(web.hive, run)
    errors = web.hive.runs.folder(run).evaluation(world.PROTOCOL.fingerprint) / "errors.csv"
    head, *rows = errors.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    for cell in cells:
        if 1010 <= float(cell[0]) <= 1012:
            cell[head.split(",").index("ape_m")] = "0.9"
    errors.write_text("\n".join([head, *map(",".join, cells)]) + "\n")
    with serving(web.hive) as address:
        yield address


def moment(page: Page, plot: str) -> float | None:
    """The time of the recording that a plot marks."""
    text = page.locator(f"[data-figure={plot}]").get_attribute("data-moment")
    return None if text is None else float(text)


def test_a_click_sets_the_moment_of_all_plots_and_of_the_address(chromium: Browser, server: str) -> None:
    with faultless(chromium, server) as page:
        visit(page, "/runs/1")
        page.wait_for_selector("[data-figure=error][data-moment]")
        over = page.locator("[data-figure=error] .u-over")
        box = over.bounding_box()
        assert box is not None
        over.click(position={"x": box["width"] / 2, "y": box["height"] / 2})
        eventually(lambda: "t=" in page.url, "the moment in the address")
        chosen = float(page.url.partition("t=")[2])
        for plot in ("error", "latency", "path"):
            assert moment(page, plot) == pytest.approx(chosen, abs=1e-3)
        page.reload(wait_until="load")
        eventually(lambda: moment(page, "error") is not None, "the plots after a reload")
        assert moment(page, "error") == pytest.approx(chosen, abs=1e-3)


def test_the_worst_moment_is_one_click_away(chromium: Browser, server: str) -> None:
    with faultless(chromium, server) as page:
        visit(page, "/runs/6?t=3")
        eventually(lambda: moment(page, "error") == 3.0, "the moment of the address")
        page.get_by_role("button", name="Worst moment").click()
        eventually(lambda: 10.0 <= (moment(page, "path") or 0) <= 12.0, "the worst moment")


def test_tabs_show_one_part_and_what_an_address_names(chromium: Browser, server: str) -> None:
    with faultless(chromium, server) as page:
        visit(page, "/runs/1")
        assert page.locator("[data-tab]:visible").count() == 1
        page.get_by_role("link", name="Metrics", exact=True).click()
        assert page.locator("#numbers").is_visible()
        page.get_by_label("Find a metric").fill("ate max")
        assert page.locator("#metrics tbody tr:visible").count() == 1
        page.goto("/runs/1#log", wait_until="load")
        assert page.locator("#output").is_visible()
        assert page.locator(".tabbar [aria-current]").inner_text() == "Log and files"


def test_a_chip_hides_its_run_and_the_sentence_leads_to_its_moment(chromium: Browser, server: str) -> None:
    with faultless(chromium, server) as page:
        visit(page, "/compare?runs=1,6")
        page.wait_for_selector("[data-figure=error][data-moment]")
        page.get_by_role("link", name="Run 6 is worse than run 1 from 10 to 12 s").click()
        eventually(lambda: 10.0 <= (moment(page, "error") or 0) <= 12.0, "the moment of the sentence")
        values = page.locator("[data-figure=error] .plot-values .value")
        assert values.count() == 2
        page.get_by_label("Show run 6").uncheck()
        assert page.locator("[data-figure=error] .plot-values .value").count() == 1


def test_pictures_of_a_recording_come_on_sight(chromium: Browser, server: str) -> None:
    with opened(chromium, server, "phone") as (page, _faults):
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        visit(page, "/datasets/room")
        page.wait_for_timeout(500)
        assert [url for url in asked if "/frames/" in url] == []
        page.locator("#recording").scroll_into_view_if_needed()
        page.locator("[data-recording] img[src*='overview=11']").first.wait_for(state="attached")
        reason = page.locator("[data-recording] [data-why]").first
        reason.filter(has_text="Frames could not be shown: ").wait_for()


@pytest.mark.parametrize("address", ["/runs/1", "/compare?runs=1,6", "/datasets/room"])
@pytest.mark.parametrize("look", ["light", "phone"])
def test_the_first_view_is_light_until_a_3d_view_is_opened(
    chromium: Browser, server: str, address: str, look: str
) -> None:
    assert look in LOOKS
    with opened(chromium, server, look) as (page, _faults):
        sent: list[int] = []
        session = page.context.new_cdp_session(page)
        session.send("Network.enable")
        session.on("Network.loadingFinished", lambda event: sent.append(int(event["encodedDataLength"])))
        visit(page, address)
        page.wait_for_timeout(500)
        assert 50_000 < sum(sent) <= FIRST_VIEW_BYTES
        assert wide_parts(page) == []
