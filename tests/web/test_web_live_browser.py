"""The page of a run that is going on: its log, progress, CPU and dropped frames come without a reload."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from slamhive.domain.run import RunState
from tests.serving import serving
from tests.web import web_world as world
from tests.web.browser_world import BROWSER, faultless

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Response, Route

pytestmark = BROWSER


@pytest.mark.parametrize("look", ["light", "phone"])
def test_log_and_dropped_frames_come_as_they_are_written(chromium: Browser, tmp_path: Path, look: str) -> None:
    with closing(world.make_hive(tmp_path)) as hive:
        world.fill(hive)
        folder = hive.runs.folder(world.RUNS["running"])
        folder.log.write_text("the first line\n")
        with serving(hive) as address, faultless(chromium, address, look=look) as page:
            page.goto(f"{address}/runs/{world.RUNS['running']}")
            log = page.get_by_role("region", name="The end of the log")
            log.get_by_text("the first line").wait_for()
            progress = page.get_by_role("region", name="Progress")
            assert "CPU" in progress.inner_text()
            page.evaluate("window.wasNotLoadedAgain = true")
            with folder.log.open("a") as file:
                file.write("the second line\n")
            folder.progress.write_text('{"fraction": 0.75, "frames": 10, "dropped": 3}')
            log.get_by_text("the second line").wait_for()
            progress.get_by_text("3 frames dropped").wait_for()
            assert page.get_by_role("progressbar").first.get_attribute("aria-valuenow") == "75"
            assert page.evaluate("window.wasNotLoadedAgain")


def test_a_run_that_ends_before_the_page_listens_is_not_shown_as_running(chromium: Browser, tmp_path: Path) -> None:
    with closing(world.make_hive(tmp_path)) as hive:
        world.fill(hive)
        run_id = world.RUNS["running"]
        with serving(hive) as address, faultless(chromium, address) as page:

            def end_first(route: Route) -> None:
                if hive.runs.get(run_id).state.active:
                    world.advance(hive, run_id, RunState.COLLECTING, RunState.SUCCEEDED, exit_code=0)
                route.continue_()

            page.route("**/events", end_first)
            answer = page.goto(f"{address}/runs/{run_id}")
            assert answer is not None
            assert 'aria-label="Progress"' in answer.text()
            page.get_by_role("region", name="Progress").wait_for(state="detached")


def test_a_page_on_which_nothing_changes_keeps_what_scripts_have_drawn(chromium: Browser, tmp_path: Path) -> None:
    with closing(world.make_hive(tmp_path)) as hive:
        world.fill(hive)
        address_of_run = f"/runs/{world.RUNS['done']}"
        with serving(hive) as address, faultless(chromium, address) as page:

            def looks_again(answer: Response) -> bool:
                return answer.url.endswith(address_of_run) and answer.request.resource_type == "fetch"

            with page.expect_response(looks_again) as again:
                page.goto(f"{address}{address_of_run}")
                page.evaluate("document.querySelectorAll('[data-swap]').forEach((part) => part.append('drawn'))")
            again.value.finished()
            page.evaluate("() => new Promise((done) => setTimeout(done, 200))")  # the answer is read and compared
            parts = page.locator("[data-swap]")
            assert parts.count() > 3
            assert parts.filter(has_text="drawn").count() == parts.count()
