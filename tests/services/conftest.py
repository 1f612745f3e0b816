"""An installation with the test algorithm and its dataset."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from slamhive.services.hive import Hive


@pytest.fixture
def hive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sqlite_template: Path) -> Iterator[Hive]:
    """Opened in a process environment that leads to it, so that commands started by a test find it too."""
    from slamhive.services.hive import open_hive  # noqa: PLC0415 - loads all there is, for seconds
    from tests.services.tiny_project import environment, make_dataset, make_project  # noqa: PLC0415

    make_project(tmp_path / "project")
    make_dataset(tmp_path / "data")
    shutil.copy(sqlite_template, tmp_path / "data" / "slamhive.db")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)
    opened = open_hive()
    yield opened
    opened.close()
