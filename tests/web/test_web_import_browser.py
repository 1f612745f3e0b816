"""Imports in a browser: a dataset from a file and from a path, an algorithm with the log of its build."""

from __future__ import annotations

import hashlib
import io
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from slamhive.base.errors import SlamHiveError
from slamhive.documents.imports import UploadRequest
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import ImageMissing
from slamhive.executors.process.executor import ProcessExecutor
from slamhive.services.hive import Hive
from tests.recordings.format_world import make_euroc
from tests.serving import serving
from tests.web import web_world as world
from tests.web.browser_world import BROWSER, DESK, PHONE, Faults, opened, violations, wide_parts
from tests.web.journey_world import Walk, known_clicks
from tests.web.test_web_uploads import tar_of

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page, Route

pytestmark = BROWSER


@dataclass
class Clicks:
    """A page, and how often it was clicked. Typing and choosing a file count as one each."""

    page: Page
    count: int = 0

    def on(self, role: str, name: str) -> None:
        self.count += 1
        self.page.get_by_role(role, name=name, exact=True).first.click()  # type: ignore[arg-type]

    def within(self, place: Locator, role: str, name: str) -> None:
        self.count += 1
        place.get_by_role(role, name=name, exact=True).click()  # type: ignore[arg-type]

    def choose(self, label: str, file: Path) -> None:
        self.count += 1
        self.page.get_by_label(label, exact=True).first.set_input_files(file)

    def type(self, place: Locator, label: str, text: str) -> None:
        self.count += 1
        place.get_by_label(label, exact=True).fill(text)


@pytest.fixture
def hive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hive]:
    """An installation for processes, since images take longer than a test."""
    (tmp_path / "hive").mkdir()
    with closing(world.make_hive(tmp_path / "hive")) as made:
        monkeypatch.setattr(type(made.executors), "choose", lambda executors, asked=None: asked or "process")
        yield made


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """The archive of a folder."""
    file = tmp_path / "desk.tar"
    file.write_bytes(tar_of(make_euroc(tmp_path / "desk")))
    return file


def sound(page: Page, faults: Faults, look: str) -> None:
    """Nothing hangs over the edge, nothing is inaccessible, nothing has failed."""
    assert wide_parts(page) == []
    assert violations(page, look) == []
    assert [fault for fault in faults.found if "ERR_FAILED" not in fault] == []


@pytest.mark.parametrize(("look", "size"), [("light", {**DESK, "width": 1440}), ("phone", PHONE), ("dark", DESK)])
def test_a_recording_becomes_a_dataset_in_five_clicks_though_the_connection_breaks(
    chromium: Browser, hive: Hive, recording: Path, look: str, size: dict[str, int]
) -> None:
    broken: list[str] = []

    def break_once(route: Route) -> None:
        if broken:
            route.continue_()
        else:
            broken.append(route.request.url)
            route.abort()

    with serving(hive) as address, opened(chromium, address, look, viewport=size) as (page, faults):
        page.route("**/parts?*", break_once)
        page.goto(address)
        clicks = Clicks(page)
        clicks.count += 1
        page.locator("details.menu > summary", has_text="New").click()
        clicks.count += 1
        page.locator("[data-new]", has_text="Import").click()
        sound(page, faults, look)
        clicks.choose("Recording", recording)
        clicks.within(page.get_by_role("form", name="Dataset from a file"), "button", "Send and look")
        page.get_by_role("heading", name="What was detected").wait_for()
        assert broken
        assert page.get_by_text("nothing is stored yet").is_visible()
        assert page.get_by_text("euroc", exact=True).is_visible()
        sound(page, faults, look)
        assert [entry.name for entry in hive.catalogue.datasets()] == ["hall", "room"]
        clicks.on("button", "Import")
        page.get_by_role("link", name="Open desk").wait_for()
        sound(page, faults, look)
        assert clicks.count == known_clicks()["a dataset by the web"][size is PHONE]
    assert hive.catalogue.dataset("desk").duration_s > 0


def test_a_file_that_was_half_sent_goes_on_where_it_ended(chromium: Browser, hive: Hive, recording: Path) -> None:
    data, sent = recording.read_bytes(), []
    promise = UploadRequest(name="desk.tar", size_bytes=len(data), sha256=hashlib.sha256(data).hexdigest())
    begun = hive.uploads.create(promise, "")
    hive.uploads.folder(begun.token, "").append(0, io.BytesIO(data[:1000]))
    with serving(hive) as address, opened(chromium, address) as (page, _):
        page.on("request", lambda request: sent.append(request.url.partition("/parts?")[2]))
        page.goto(f"{address}/import")
        page.get_by_label("Recording", exact=True).set_input_files(recording)
        page.get_by_role("button", name="Send and look").first.click()
        page.get_by_role("heading", name="What was detected").wait_for()
    assert [part for part in sent if part] == ["offset=1000"]
    assert [upload.token for upload in hive.uploads.listed("")] == [begun.token]


def test_a_path_that_is_refused_keeps_what_was_typed_and_can_be_corrected(
    chromium: Browser, hive: Hive, tmp_path: Path
) -> None:
    (tmp_path / "odd").mkdir()
    with serving(hive) as address, opened(chromium, address) as (page, faults):
        page.goto(f"{address}/import")
        clicks = Clicks(page)
        page.get_by_text("From a path on the server").click()
        form = page.get_by_role("form", name="Dataset from a path")
        clicks.type(form, "Path", str(tmp_path / "odd"))
        clicks.within(form, "button", "Look at the path")
        page.get_by_role("alert").get_by_text("is in no format that can be imported").wait_for()
        page.get_by_role("form", name="Say more").get_by_label("Format", exact=True).wait_for()
        sound(page, faults, "light")
    assert not list((hive.settings.data / "datasets").glob("odd*"))


@pytest.fixture
def package(hive: Hive, tmp_path: Path) -> Path:
    """A package under a name that is free."""
    folder = tmp_path / "new-slam"
    shutil.copytree(hive.catalogue.project_root / "algorithms" / "beam-odometry", folder)
    file = folder / "algorithm.yaml"
    file.write_text(file.read_text().replace("package: beam-odometry", "package: new-slam"))
    return folder


@pytest.mark.parametrize(("place", "size"), [(0, {**DESK, "width": 1440}), (1, PHONE)])
def test_the_log_of_a_build_comes_live_and_the_algorithm_is_there(
    chromium: Browser, hive: Hive, package: Path, monkeypatch: pytest.MonkeyPatch, place: int, size: dict[str, int]
) -> None:
    go_on = threading.Event()

    def build(_executor: object, _package: AlgorithmPackage, progress: Callable[[str], None]) -> str:
        progress("Step 1/2 : the first")
        go_on.wait(60)
        progress("Step 2/2 : the second")
        return "identity"

    monkeypatch.setattr(ProcessExecutor, "build", build)
    with serving(hive) as address, opened(chromium, address, viewport=size) as (page, faults):
        page.goto(address)
        walk = Walk(page)
        walk.new("Import")
        walk.click(page.get_by_text("From a folder on the server"))
        form = page.get_by_role("form", name="Algorithm from a path")
        walk.type(form.get_by_label("Path", exact=True), str(package))
        walk.click(form.get_by_role("button", name="Look at the folder"))
        page.get_by_text("a package with 1 algorithm: new-slam").wait_for()
        walk.click(page.get_by_role("button", name="Build and import"))
        page.get_by_role("region", name="Log, as it comes").get_by_text("Step 1/2 : the first").wait_for()
        go_on.set()
        page.get_by_role("link", name="Open new-slam").wait_for()  # the page follows by itself
        sound(page, faults, "light")
        assert (walk.clicks, walk.wide) == (known_clicks()["an algorithm by the web"][place], [])
    assert hive.catalogue.algorithm("new-slam").title


def test_a_build_is_cancelled_and_one_that_fails_leads_with_its_reason(
    chromium: Browser, hive: Hive, package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fails = threading.Event()

    def build(_executor: object, _package: AlgorithmPackage, progress: Callable[[str], None]) -> str:
        for number in range(600):
            progress(f"compiling {number}")
            if fails.wait(0.1):
                raise ImageMissing("building new-slam failed at Step 2/2: no compiler")
        raise AssertionError

    monkeypatch.setattr(ProcessExecutor, "build", build)
    with serving(hive) as address, opened(chromium, address) as (page, faults):
        page.goto(f"{address}/import")
        page.get_by_text("From a folder on the server").click()
        form = page.get_by_role("form", name="Algorithm from a path")
        form.get_by_label("Path", exact=True).fill(str(package))
        form.get_by_role("button", name="Look at the folder").click()
        page.get_by_role("button", name="Build and import").click()
        page.get_by_role("button", name="Cancel").click()
        page.get_by_text("The import was cancelled").wait_for()
        fails.set()
        page.get_by_role("button", name="Try again").click()
        page.get_by_role("alert").get_by_text("failed at Step 2/2: no compiler").wait_for()
        assert page.get_by_role("region", name="The last lines of the log").is_visible()
        sound(page, faults, "light")
    with pytest.raises(SlamHiveError):
        hive.catalogue.algorithm("new-slam")
