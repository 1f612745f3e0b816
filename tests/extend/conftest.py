"""The examples of the documentation, installed once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.extend.plugin_packages import install, write_examples


@pytest.fixture(scope="session")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which every example is installed."""
    folder = tmp_path_factory.mktemp("examples")
    return install(write_examples(folder / "packages"), folder / "installed")
