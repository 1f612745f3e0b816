"""The installations for the journeys of a user, with a worker, and a count of what the user presses."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamhive.recordings.room.world import motion_at
from slamhive.services import demo
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from tests.services import tiny_project
from tests.sharing import share_environments
from tests.web import web_world as world
from tests.web.browser_world import PHONE, wide_parts

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

PLAN = """\
name: eyes
description: Do two eyes see better than one?
algorithms: eye-slam-mono | eye-slam-stereo
datasets: room
parameters:
  nFeatures: 500 | 1000
repeats: 3
executor: process
"""
ERRORS_M = ((0.30, 0.33, 0.31), (0.26, 0.28, 0.27), (0.12, 0.13, 0.11), (0.050, 0.052, 0.070))
"""Of the repeats of each configuration; those of stereo with 1000 features are the smallest."""
WORST_S = (10.0, 12.0)
"""When the last run is far off."""
SIZES: dict[str, dict[str, Any]] = {
    "1440 px": {"viewport": {"width": 1440, "height": 900}},
    "390 px": {"viewport": PHONE, "has_touch": True},
}
STYLE = Path(__file__).resolve().parents[2] / "docs" / "page-style.md"
ROW = re.compile(r"^\| (\w[^|]*?) \|(?: [^|]* \|)? (\d+) \| (\d+) \|$", re.MULTILINE)


def known_clicks() -> dict[str, tuple[int, ...]]:
    """The clicks of each journey at each of ``SIZES``, as the documentation has them."""
    text = STYLE.read_text(encoding="utf-8").partition("\n## Journeys\n")[2].partition("\n## ")[0]
    return {name: (int(wide), int(small)) for name, wide, small in ROW.findall(text)}


class Walk:
    """Somebody who uses a page, and how often they clicked, or pressed a key that does something.

    Typing a word, and choosing from a list that is open, are not counted; opening the list is.
    """

    def __init__(self, page: Page) -> None:
        self.page = page
        self.clicks = 0
        self.wide: list[str] = []

    @property
    def width_px(self) -> int:
        """The width of the window."""
        size = self.page.viewport_size
        assert size is not None
        return size["width"]

    def click(self, target: Locator) -> None:
        """Click on something that is there and visible; wait for all of the page to which it leads."""
        self._count()
        target.click()
        # Playwright waits until the answer begins. What is counted or asked then would be a part of the page.
        self.page.wait_for_load_state("load")

    def choose(self, target: Locator, value: str, *, leads: bool = False) -> None:
        """Choose from a list; ``leads``: which shows another page."""
        self._count()
        if not leads:
            target.select_option(value)
            return
        with self.page.expect_navigation():
            target.select_option(value)

    def enter(self, target: Locator, text: str) -> None:
        """Type a line and press Enter, which shows another page."""
        target.fill(text)
        self._count()
        with self.page.expect_navigation():
            target.press("Enter")

    def give(self, target: Locator, file: Path) -> None:
        """Choose a file."""
        self._count()
        target.set_input_files(file)

    def type(self, target: Locator, text: str) -> None:
        """Type into a field, which takes a click unless it has the focus."""
        if not target.evaluate("element => element === document.activeElement"):
            self.click(target)
        target.fill(text)

    def link(self, name: str, *, exact: bool = True) -> Locator:
        """The first visible link with a name."""
        return self.page.get_by_role("link", name=name, exact=exact).first

    def button(self, name: str, *, exact: bool = True) -> Locator:
        """The first visible button with a name."""
        return self.page.get_by_role("button", name=name, exact=exact).first

    def section(self, name: str) -> None:
        """Go to a section by the rail, which is behind a button on a phone."""
        rail = self.page.get_by_role("navigation", name="Main")
        if not rail.is_visible():
            self.click(self.button("Menu"))
        self.click(rail.get_by_role("link", name=name))

    def new(self, name: str) -> None:
        """Choose from the menu *New*."""
        self.click(self.page.locator("summary", has_text="New").first)
        self.click(self.page.locator("[data-new]", has_text=re.compile(rf"^{name}\b")))

    def look(self) -> None:
        """Note what of the page is wider than the window, once it has its styles."""
        self.page.locator("main").wait_for()
        self.wide += [f"{self.page.url}: {part}" for part in wide_parts(self.page)]

    def _count(self) -> None:
        self.look()
        self.clicks += 1


def furnish(folder: Path, template: Path) -> Hive:
    """An installation with an experiment whose runs have ended, and an algorithm that can be run."""
    hive = world.make_hive(folder, template=template)
    hive.settings = hive.settings.with_values({"executor": "process", "poll_interval_s": 0.02})
    tiny = tiny_project.make_project(folder / "tiny")
    (tiny / "algorithms" / "tiny").rename(folder / "project" / "algorithms" / "tiny")
    (folder / "project" / "evaluation").symlink_to(STYLE.parents[1] / "evaluation")
    tiny_project.make_dataset(folder / "data", "track")
    share_environments(folder / "data")
    hive.experiments.start(ExperimentSource(PLAN))
    for cell, errors_m in zip(hive.experiments.cells("eyes").cells, ERRORS_M, strict=True):
        for run, error_m in zip(cell.runs, errors_m, strict=True):
            world.finish_run(hive, run.id)
            world.evaluate_run(hive, run.id, error_m)
    stray(hive, run.id)
    return hive


DEMO = "name: room-demo\nalgorithms: tiny\ndatasets: room\nevaluate: {trajectory: live}\n"
DEMO_S = 1.0


def furnish_nothing(folder: Path, template: Path) -> Hive:
    """An installation without data, whose demo has one algorithm. It knows the path through a room of ``DEMO_S``."""
    root = tiny_project.make_project(folder / "project")
    (root / "templates").rmdir()
    for name in ("templates", "static"):
        (root / name).symlink_to(STYLE.parents[1] / name)
    (root / demo.FILE).parent.mkdir(parents=True)
    (root / demo.FILE).write_text(DEMO)
    package = root / "algorithms" / "tiny"
    described = (package / "algorithm.yaml").read_text()
    (package / "algorithm.yaml").write_text(
        described.replace("trajectory_role: points", "trajectory_role: points\n    trajectory: live")
    )
    times_s = np.arange(0, DEMO_S, 0.02)
    positions_m = motion_at(times_s, DEMO_S).positions_m + np.random.default_rng(1).normal(0, 0.005, (len(times_s), 3))
    rows = (
        f"{1000 + at_s:.6f} {x_m} {y_m} {z_m} 0 0 0 1\\n"
        for at_s, (x_m, y_m, z_m) in zip(times_s, positions_m, strict=True)
    )
    mapping = (package / "slamhive" / "mapping.py").read_text()
    assert 'poses = "".join' in mapping
    lines = [
        f'poses = "{"".join(rows)}"' if line.startswith('poses = "".join') else line for line in mapping.splitlines()
    ]
    (package / "slamhive" / "mapping.py").write_text("\n".join(lines))
    hive = world.make_hive(folder, empty=True, template=template)
    hive.settings = hive.settings.with_values({"executor": "process", "poll_interval_s": 0.02})
    share_environments(folder / "data")
    return hive


def stray(hive: Hive, run_id: int) -> None:
    """Let a run be far off for two seconds."""
    file = hive.runs.folder(run_id).evaluation(world.PROTOCOL.fingerprint) / "errors.csv"
    head, *rows = file.read_text().splitlines()
    first_s, last_s = (1000 + at_s for at_s in WORST_S)
    cells = [row.split(",") for row in rows]
    strayed = [f"{at},{0.9 if first_s <= float(at) <= last_s else error}" for at, error in cells]
    file.write_text("\n".join([head, *strayed]) + "\n")


@contextmanager
def worker_beside(hive: Hive) -> Iterator[None]:
    """A worker that takes whatever is asked for meanwhile."""
    worker = hive.worker()
    thread = threading.Thread(target=worker.run)
    thread.start()
    try:
        yield
    finally:
        worker.stop()
        thread.join()
