"""The picker of pre-processing steps: fields and text say the same, whichever is changed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from slamhive.services.hive import Hive
from tests.serving import serving
from tests.web import web_world as world
from tests.web.browser_world import BROWSER, faultless, violations, wide_parts

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = BROWSER

FORM = "/runs/new?algorithm=eye-slam-stereo&dataset=room"


@pytest.fixture
def hive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hive]:
    with closing(world.make_hive(tmp_path)) as made:
        monkeypatch.setattr(type(made.executors), "choose", lambda executors, asked=None: asked or "process")
        yield made


def text_of(page: Page) -> str:
    return page.locator("#field-steps").input_value()


def add(page: Page, kind: str) -> None:
    page.get_by_label("Add a step").select_option(kind)


@pytest.mark.parametrize("look", ["light", "phone", "dark"])
def test_steps_are_chosen_filled_ordered_and_removed(chromium: Browser, hive: Hive, look: str) -> None:
    with serving(hive) as address, faultless(chromium, address, look=look) as page:
        page.goto(address + FORM)
        assert not page.locator("#field-steps").is_visible()
        add(page, "resolution")
        first = page.get_by_role("group", name="Step 1: resolution")
        assert "above 0, at most 1" in first.inner_text()
        assert first.get_by_label("scale").get_attribute("placeholder") == "required"
        first.get_by_label("scale").fill("0.5")
        first.get_by_label("interpolation").select_option("bilinear")
        assert text_of(page) == "resolution scale=0.5 interpolation=bilinear"
        assert first.get_by_label("camera0").count() == 1
        assert first.get_by_label("imu2").count() == 0  # a resolution is of images
        first.get_by_label("camera1").check()
        add(page, "rate")
        page.get_by_role("group", name="Step 2: rate").get_by_label("hz").fill("5")
        assert text_of(page) == "resolution@camera1 scale=0.5 interpolation=bilinear\nrate hz=5"
        page.get_by_role("group", name="Step 2: rate").get_by_role("button", name="Move up").click()
        assert text_of(page) == "rate hz=5\nresolution@camera1 scale=0.5 interpolation=bilinear"
        assert wide_parts(page) == []
        assert violations(page, look) == []
        page.get_by_role("group", name="Step 2: resolution").get_by_role("button", name="Remove").click()
        assert text_of(page) == "rate hz=5"


def test_the_text_changes_the_fields_and_keeps_what_it_cannot_show(chromium: Browser, hive: Hive) -> None:
    with serving(hive) as address, faultless(chromium, address) as page:
        page.goto(address + FORM)
        page.get_by_text("As text").click()
        page.locator("#field-steps").fill("rate@camera0 hz=4\nblend it")
        rate = page.get_by_role("group", name="Step 1: rate")
        assert rate.get_by_label("hz").input_value() == "4"
        assert rate.get_by_label("camera0").is_checked()
        assert "blend it" in page.get_by_role("group", name="Step 2: unknown").inner_text()
        rate.get_by_label("hz").fill("8")
        assert text_of(page) == "rate@camera0 hz=8\nblend it"


def test_a_wrong_value_is_refused_at_once_and_a_right_one_is_started(chromium: Browser, hive: Hive) -> None:
    with serving(hive) as address, faultless(chromium, address) as page:
        page.goto(address + FORM)
        add(page, "resolution")
        scale = page.get_by_role("group", name="Step 1: resolution").get_by_label("scale")
        scale.fill("2")
        page.locator("#error-steps", has_text="scale").wait_for()
        scale.fill("0.5")
        page.locator("#error-steps").wait_for(state="hidden")
        page.get_by_label("Algorithm", exact=True).select_option("eye-slam-mono")  # the form is loaded again
        page.wait_for_url("**algorithm=eye-slam-mono**")
        assert page.get_by_role("group", name="Step 1: resolution").get_by_label("scale").input_value() == "0.5"


def test_without_scripts_the_text_is_there(chromium: Browser, hive: Hive) -> None:
    with serving(hive) as address, faultless(chromium, address, java_script_enabled=False) as page:
        page.goto(address + FORM)
        assert page.locator("#field-steps").is_visible()
        assert not page.get_by_label("Add a step").is_visible()


def test_a_variant_of_a_dataset_is_made_with_the_same_picker(chromium: Browser, hive: Hive) -> None:
    with serving(hive) as address, faultless(chromium, address) as page:
        page.goto(f"{address}/datasets/room")
        add(page, "rate")
        page.get_by_role("group", name="Step 1: rate").get_by_label("hz").fill("5")
        assert text_of(page) == "rate hz=5"
