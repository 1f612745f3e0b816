"""The examples of the documentation, installed once, and what carries out commands."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.extend.plugin_packages import install, write_examples
from tests.forked_commands import Run, forked_commands
from tests.sharing import made_once


@pytest.fixture(scope="session")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which every example is installed."""
    sources = tmp_path_factory.mktemp("examples")
    return made_once("examples", lambda folder: install(write_examples(sources), folder))


@pytest.fixture(scope="session")
def carry_out() -> Iterator[Run]:
    """Carries out a command in a process of its own."""
    with forked_commands() as run:
        yield run
