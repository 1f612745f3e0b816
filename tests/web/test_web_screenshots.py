"""The pictures in the documentation are pages of real runs, and none shows a page that looks different by now.

``UPDATE_SCREENSHOTS=1 make test TIERS=pictures`` takes all of them again.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from slamhive.domain.metrics.measured import MEASURED_METRICS
from slamhive.domain.metrics.model import Group
from slamhive.services.hive import Hive, open_hive
from tests.real_datasets import dataset
from tests.serving import serving
from tests.sharing import share_environments
from tests.web.browser_world import BROWSER, faultless, visit

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.pictures, pytest.mark.timeout(1500), *BROWSER[1:]]

ROOT = Path(__file__).resolve().parents[2]
EXPERIMENT = ROOT / "docs" / "examples" / "room-demo.yaml"
IMAGES = ROOT / "docs" / "images"
WORDS = IMAGES / "pages.json"
"""The words that each picture shows, except values and names of the machine."""
UPDATE = os.environ.get("UPDATE_SCREENSHOTS", "") not in {"", "0"}
REMEDY = "run: UPDATE_SCREENSHOTS=1 make test TIERS=pictures"
FIXED = "h1, h2, h3, th, label, button, legend, summary:not(dd summary)"
"""What a page says whatever it shows."""
CHANCE = re.compile(r"-[0-9a-f]{6}\b|\b(?:very )?doubtful\b|\d+")
"""What differs from one demo to the next: names of experiments, how quiet the machine was, numbers."""

OF_THE_MACHINE = tuple(metric.label for metric in MEASURED_METRICS if metric.group in {Group.MACHINE, Group.TIMING})
"""Metrics that some machines do not measure, or that are the same for all runs on a fast one."""


@dataclass(frozen=True)
class Picture:
    """A picture of the documentation: the page, and what is pressed before it is taken."""

    name: str
    address: str
    press: str = ""
    part: str = ""
    """The part of the page; without it, the window."""
    look: str = "light"


PICTURES = (
    Picture("run", "/runs/3"),
    Picture("runs", "/runs"),
    Picture("comparison", "/compare?runs=1,2,3"),
    Picture("viewer", "/runs/3", press="Open 3D view", part="[data-viewer]"),
    Picture("experiment", "/experiments/{experiment}"),
    Picture("dataset", "/datasets/room"),
    Picture("new-experiment", "/new-experiment", look="dark"),
)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Hive]]:
    """A server of a data root with the experiment of ``slamhive demo``, and its services. ``DEMO_ROOT`` names one.

    Played sequentially, so that a busy machine drops no frames and the pictures do not depend on it.
    """
    data = Path(os.environ.get("DEMO_ROOT") or tmp_path_factory.mktemp("demo") / "data")
    if not data.exists():
        data.mkdir()
        share_environments(data)
        with contextlib.closing(open_hive({"data": data})) as hive:
            dataset(hive, "room")  # which other tiers render too
        file = data.with_name("room-demo.yaml")
        file.write_text(EXPERIMENT.read_text(encoding="utf-8") + "playback: {mode: sequential}\n", encoding="utf-8")
        command = [sys.executable, "-m", "slamhive", "--data", str(data), "experiment", "start", str(file)]
        command += ["--wait", "--yes"]
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=1400)
    hive = open_hive({"data": data})
    with serving(hive) as server:
        yield server, hive
    hive.close()


def taken(page: Page, picture: Picture) -> tuple[bytes, list[str]]:
    """The picture as PNG, and the words on it that do not depend on what the demo measured."""
    if picture.press:
        page.get_by_role("button", name=picture.press).click()
        page.wait_for_selector("[data-viewer][data-ready]", timeout=60_000)
    page.wait_for_timeout(500)
    shown = page.locator(picture.part) if picture.part else page
    words = (shown.locator(FIXED) if picture.part else page.locator("main").locator(FIXED)).all_inner_texts()
    kept = (text for text in words if not text.startswith(OF_THE_MACHINE))
    return shown.screenshot(), sorted({" ".join(CHANCE.sub("", text).split()) for text in kept} - {""})


@functools.cache
def known_words() -> dict[str, list[str]]:
    """The words on each picture when it was taken."""
    return json.loads(WORDS.read_text(encoding="utf-8")) if WORDS.is_file() else {}


def size_px(png: bytes) -> tuple[int, int]:
    """Width and height out of the header of a PNG."""
    return struct.unpack(">II", png[16:24])


@pytest.mark.parametrize("picture", PICTURES, ids=lambda picture: picture.name)
def test_pictures_show_the_pages_of_today(chromium: Browser, demo: tuple[str, Hive], picture: Picture) -> None:
    file = IMAGES / f"{picture.name}.png"
    server, hive = demo
    (experiment,) = hive.experiments.list()
    with faultless(chromium, server, look=picture.look) as page:
        visit(page, picture.address.format(experiment=experiment.name))
        png, words = taken(page, picture)
    if UPDATE:
        file.write_bytes(png)
        known_words()[picture.name] = words
        WORDS.write_text(
            json.dumps(known_words(), indent=1, sort_keys=True, ensure_ascii=False) + "\n", encoding="utf-8"
        )
    assert file.is_file(), REMEDY
    assert size_px(file.read_bytes()) == pytest.approx(size_px(png), abs=8), REMEDY  # a value may need a line more
    assert known_words()[picture.name] == words, REMEDY
