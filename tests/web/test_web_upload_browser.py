"""An image file is sent to a challenge from its page: in parts, with its checksum, over a connection that breaks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from slamhive.services.hive import Hive, open_hive
from tests.services.image_world import image_challenge
from tests.services.tiny_project import environment, make_dataset, make_project
from tests.serving import serving
from tests.web.browser_world import BROWSER, faultless, opened
from tests.web.test_web_challenges import image_archive

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

pytestmark = BROWSER

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def hive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hive]:
    """An installation with a challenge that takes images."""
    project = make_project(tmp_path / "project")
    (project / "templates").rmdir()
    for name in ("templates", "static"):
        (project / name).symlink_to(ROOT / name)
    make_dataset(tmp_path / "data", "room")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)
    with closing(open_hive({"data": str(tmp_path / "data")})) as opened_hive:
        opened_hive.challenges.create(image_challenge(tmp_path / "organiser"))
        yield opened_hive


def submit(page: Page, file: Path) -> None:
    form = page.get_by_role("form", name="New submission of an image file")
    form.get_by_label("Team").fill("ours")
    form.get_by_label("Image file").set_input_files(file)
    form.get_by_role("button", name="Submit image").click()


def test_an_image_is_sent_though_the_connection_breaks(chromium: Browser, hive: Hive, tmp_path: Path) -> None:
    image_archive(tmp_path)
    broken: list[str] = []

    def break_once(route: Route) -> None:
        if broken:
            route.continue_()
        else:
            broken.append(route.request.url)
            route.abort()

    with serving(hive) as address, opened(chromium, address) as (page, faults):
        page.route("**/parts?*", break_once)
        page.goto(f"{address}/challenges/rooms")
        submit(page, tmp_path / "image.tar")
        page.locator("summary", has_text="team ours").wait_for()
        assert "image team-x" in page.locator("summary", has_text="team ours").inner_text()
        assert broken
        assert [fault for fault in faults.found if "ERR_FAILED" not in fault] == []
    (sent,) = hive.challenges.submissions("rooms")
    assert (sent.team, sent.image, sent.state.value) == ("ours", "team-x", "queued")
    assert hive.uploads.listed("") == []


def test_what_is_no_image_is_refused_in_a_line(chromium: Browser, hive: Hive, tmp_path: Path) -> None:
    (tmp_path / "image.tar").write_bytes(b"nothing of this kind")
    with serving(hive) as address, opened(chromium, address) as (page, _):
        page.goto(f"{address}/challenges/rooms")
        submit(page, tmp_path / "image.tar")
        page.get_by_text("The image was not submitted: ").wait_for()
        assert page.get_by_role("button", name="Submit image").is_enabled()
    assert hive.challenges.submissions("rooms") == []


def test_without_scripts_the_page_leads_to_the_client(chromium: Browser, hive: Hive) -> None:
    with serving(hive) as address, faultless(chromium, address, java_script_enabled=False) as page:
        page.goto(f"{address}/challenges/rooms")
        assert page.get_by_role("button", name="Submit image").count() == 0
        assert page.get_by_text("submit_image").is_visible()
