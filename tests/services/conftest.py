"""An installation with the test algorithm and its dataset."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from slamhive.services.hive import Hive


@pytest.fixture
def hive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sqlite_template: Path) -> Iterator[Hive]:
    """Opened in a process environment that leads to it, so that commands started by a test find it too."""
    with opened_hive(tmp_path, monkeypatch, sqlite_template) as opened:
        yield opened


@contextmanager
def opened_hive(folder: Path, patch: pytest.MonkeyPatch, sqlite_template: Path) -> Iterator[Hive]:
    """An installation below ``folder``, opened in a process environment that leads to it."""
    from slamhive.services.hive import open_hive  # noqa: PLC0415 - loads all there is, for seconds
    from tests.services.tiny_project import environment, make_dataset, make_project  # noqa: PLC0415

    make_project(folder / "project")
    make_dataset(folder / "data")
    shutil.copy(sqlite_template, folder / "data" / "slamhive.db")
    for key, value in environment(folder / "project", folder / "data").items():
        patch.setenv(key, value)
    opened = open_hive()
    yield opened
    opened.close()
