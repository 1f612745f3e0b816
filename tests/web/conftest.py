"""A filled installation, made once; tests that change it get one of their own."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.web import web_world as world
from tests.web.web_world import Web, make_web

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="session")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a filled installation that nobody has opened."""
    folder = tmp_path_factory.mktemp("filled")
    hive = world.make_hive(folder)
    world.fill(hive)
    hive.close()
    return folder


@pytest.fixture(scope="session")
def looked_at(filled: Path) -> Iterator[Web]:
    """What ``shown`` is, without the look whether a test has changed it."""
    web = make_web(world.make_hive(filled))
    yield web
    web.hive.close()


@pytest.fixture
def shown(looked_at: Web) -> Iterator[Web]:
    """An installation to look at; a test that changes it fails, because later tests would fail in its place."""
    before = world.content(looked_at.hive)
    yield looked_at
    after = world.content(looked_at.hive)
    changed = [name for name in before.keys() | after.keys() if before.get(name) != after.get(name)]
    assert not changed, f"{', '.join(changed)} changed, and all tests look at it: let a test that changes it use 'web'"


@pytest.fixture
def web(filled: Path, tmp_path: Path) -> Iterator[Web]:
    """An installation of the test's own."""
    shutil.copytree(filled, tmp_path, symlinks=True, dirs_exist_ok=True)
    web = make_web(world.make_hive(tmp_path))
    yield web
    web.hive.close()


@pytest.fixture
def empty(tmp_path: Path, sqlite_template: Path) -> Iterator[Web]:
    """An installation without datasets and runs."""
    web = make_web(world.make_hive(tmp_path, empty=True, template=sqlite_template))
    yield web
    web.hive.close()


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    """One browser for all tests."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - only this tier has it

    from tests.web.browser_world import CHROMIUM, OPTIONS  # noqa: PLC0415 - else every module may be in this tier

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(OPTIONS))
        yield browser
        browser.close()
