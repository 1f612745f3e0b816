"""The 3D view in a real browser with software GL: pixels, time, keys, PNG, and pages without WebGL."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.image
import numpy as np
import pytest

from slamhive.base.settings import Mode
from slamhive.domain.protocol import TrajectoryKind
from tests.serving import serving
from tests.waiting import eventually
from tests.web import web_world as world
from tests.web.browser_world import BROWSER, LOOKS, faultless, violations, wide_parts
from tests.web.web_world import RUNS, Web, make_web

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = BROWSER
DONE = RUNS["done"]
MAP_POINTS = 150_000
SMALL = {"viewport": {"width": 800, "height": 600}}
"""Without a GPU, drawing takes as long as there are pixels."""
NO_WEBGL = """const known = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  return kind.startsWith("webgl") ? null : known.call(this, kind, ...more);
};"""


@pytest.fixture(scope="module")
def mapped(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Web]:
    """A view-only archive whose finished run has a live trajectory and a map with intensities."""
    folder = tmp_path_factory.mktemp("mapped")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    web = make_web(world.make_hive(folder, Mode.VIEW_ONLY))
    run = web.hive.runs.folder(DONE)
    np.savetxt(run.trajectory_of(TrajectoryKind.LIVE), world.loop_path(noise_m=0.1))
    rng = np.random.default_rng(2)
    walls = rng.uniform((-12, -8, -2, 0), (12, 8, 3, 255), (MAP_POINTS, 4))
    walls[::2, 1] = 8
    walls[1::2, 2] = -2
    head = "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS {n}\nWIDTH {n}\nDATA binary\n"
    run.map.write_bytes(head.format(n=MAP_POINTS).encode() + walls.astype("<f4").tobytes())
    yield web
    web.hive.close()


@pytest.fixture(scope="module")
def server(mapped: Web) -> Iterator[str]:
    """The address of the archive."""
    with serving(mapped.hive) as address:
        yield address


@pytest.fixture
def opened(chromium: Browser, server: str) -> Iterator[Callable[..., Page]]:
    """Opens the 3D view of a page. Any fault on the way fails the test."""
    with ExitStack() as contexts:

        def open_view(address: str, look: str = "light", **more: Any) -> Page:
            page = contexts.enter_context(faultless(chromium, server, look=look, **{**SMALL, **more}))
            page.goto(address, wait_until="load")
            page.get_by_role("button", name="Open 3D view").click()
            page.wait_for_selector("[data-viewer][data-ready]", timeout=60_000)
            return page

        yield open_view


def pixels(page: Page) -> np.ndarray[Any, Any]:
    """The picture of the view without the outline of its focus, as (height, width, 3), 0 to 1."""
    page.wait_for_timeout(300)
    png = page.locator("[data-viewer] canvas").screenshot()
    return np.asarray(matplotlib.image.imread(io.BytesIO(png)))[8:-8, 8:-8, :3]


def colourful(picture: np.ndarray[Any, Any]) -> float:
    """The share of pixels that are not grey."""
    return float((np.ptp(picture, axis=2) > 0.15).mean())


@pytest.mark.parametrize("look", LOOKS)
def test_paths_and_map_are_drawn(opened: Callable[..., Page], look: str) -> None:
    page = opened(f"/runs/{DONE}", look, **LOOKS[look])
    assert colourful(pixels(page)) > 0.03, "the map"
    panel = page.locator("[data-viewer]")
    assert str(panel.get_attribute("data-points")).startswith("thinned ")
    assert "of 150,000 points of the map" in panel.locator("[data-says]").inner_text()
    assert panel.locator("[data-paths] li").count() == 3
    panel.get_by_label("Map by").select_option("none")
    without = colourful(pixels(page))
    assert 0.0005 < without < 0.03, "only the paths"
    assert wide_parts(page) == []
    if look == "dark":
        assert violations(page) == []


def test_colours_follow_what_is_chosen(opened: Callable[..., Page]) -> None:
    page = opened(f"/runs/{DONE}")
    panel = page.locator("[data-viewer]")
    by_height = pixels(page)
    panel.get_by_label("Map by").select_option("intensity")
    assert np.abs(pixels(page) - by_height).max(axis=2).mean() > 0.02
    panel.get_by_label("Map by").select_option("none")
    seen = []
    for by in ("own", "error", "speed", "time"):
        panel.get_by_label("Trajectories by").select_option(by)
        seen.append(pixels(page))
        legend = panel.locator("[data-scale=paths]")
        assert legend.is_visible() == (by != "own")
    apart = [np.abs(first - second).max() for place, first in enumerate(seen) for second in seen[:place]]
    assert min(apart) > 0.1
    assert panel.locator("[data-paint=map] option[value=error]").is_disabled(), "this dataset has no reference map"


def test_time_moves_the_marks_and_the_plots(opened: Callable[..., Page]) -> None:
    page = opened(f"/runs/{DONE}")
    page.wait_for_selector("[data-figure=error][data-drawn]", timeout=60_000)
    panel = page.locator("[data-viewer]")
    panel.get_by_label("Map by").select_option("none")
    before, first_at = pixels(page), panel.get_attribute("data-at")
    slider = panel.get_by_label("Time [s]")
    slider.fill("12")
    assert panel.get_attribute("data-at") != first_at
    assert np.abs(pixels(page) - before).max() > 0.2
    marked = "Number(document.querySelector('[data-figure=error]').dataset.moment ?? -1)"
    eventually(lambda: abs(page.evaluate(marked) - 12) < 0.1, "the line in the plot of the error")
    page.evaluate("document.dispatchEvent(new CustomEvent('moment', { detail: 1005.0 }))")
    assert float(slider.input_value()) == pytest.approx(5.0, abs=0.02)
    panel.get_by_role("button", name="Play").click()
    eventually(lambda: float(slider.input_value()) > 6, "playback")
    panel.get_by_role("button", name="Pause").click()


def test_a_view_starts_at_the_moment_that_the_page_shows(chromium: Browser, server: str) -> None:
    with faultless(chromium, server) as page:
        page.goto(f"/runs/{DONE}?t=7.5", wait_until="load")
        page.wait_for_selector("[data-figure=error][data-moment='7.5']", timeout=60_000)
        page.get_by_role("button", name="Open 3D view").click()
        page.wait_for_selector("[data-viewer][data-ready]", timeout=60_000)
        assert float(page.locator("[data-time-of-view]").input_value()) == pytest.approx(7.5, abs=0.02)


def test_the_keyboard_does_everything(opened: Callable[..., Page]) -> None:
    page = opened(f"/runs/{DONE}", reduced_motion="reduce")
    panel = page.locator("[data-viewer]")
    assert page.evaluate("document.activeElement.tagName") == "CANVAS"
    home = pixels(page)
    page.keyboard.press("ArrowRight")
    page.keyboard.press("+")
    assert np.abs(pixels(page) - home).max() > 0.2
    page.keyboard.press("r")
    assert np.abs(pixels(page) - home).mean() < 0.002
    page.keyboard.press("f")
    assert panel.get_by_role("button", name="Follow").get_attribute("aria-pressed") == "true"
    following = pixels(page)
    page.keyboard.press(".")
    page.keyboard.press(".")
    assert np.abs(pixels(page) - following).mean() > 0.002, "the camera goes along"
    page.keyboard.press("Space")
    assert panel.get_by_role("button", name="Pause").is_visible()
    page.keyboard.press("Space")
    with page.expect_download() as download:
        page.keyboard.press("p")
    assert download.value.suggested_filename == f"run-{DONE}-3d.png"
    saved = matplotlib.image.imread(download.value.path(), format="png")
    canvas = panel.locator("canvas").bounding_box()
    assert canvas is not None
    assert saved.shape[1] == pytest.approx(canvas["width"], abs=2)
    assert saved.shape[0] > canvas["height"] + 60, "lines of text below the picture"
    assert colourful(saved[:, :, :3]) > 0.01


def test_comparisons_and_datasets_have_the_same_view(opened: Callable[..., Page]) -> None:
    page = opened(f"/compare?runs={DONE},{RUNS['bare']}")
    assert colourful(pixels(page)) > 0.0005
    assert "not evaluated under this protocol" in page.locator("[data-says]").inner_text()
    page = opened("/datasets/room")
    picture = pixels(page)
    assert float((picture.max(axis=2) < 0.4).mean()) > 0.0005, "the grey line of the ground truth"


def test_three_js_comes_only_when_it_is_asked_for(chromium: Browser, server: str) -> None:
    with faultless(chromium, server) as page:
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto(f"/runs/{DONE}", wait_until="load")
        page.wait_for_selector("[data-figure=path][data-drawn]", timeout=60_000)
        assert not [url for url in asked if "three" in url or "/viewer/" in url or "scene.json" in url]
        page.get_by_role("button", name="Open 3D view").click()
        page.wait_for_selector("[data-viewer][data-ready]", timeout=60_000)
        assert len([url for url in asked if "three.core" in url]) == 1


def test_without_webgl_a_line_says_why(chromium: Browser, server: str) -> None:
    with faultless(chromium, server) as page:
        page.context.add_init_script(NO_WEBGL)
        page.goto(f"/runs/{DONE}", wait_until="load")
        page.wait_for_selector("[data-figure=path][data-drawn]", timeout=60_000)
        page.get_by_role("button", name="Open 3D view").click()
        assert "no WebGL 2" in page.locator("[data-says]").inner_text()
        assert not page.get_by_role("button", name="Open 3D view").is_visible()
