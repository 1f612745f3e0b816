from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.sharing import made_once

OUTSIDE = (
    ("evalio>=0.6.1", "asteval", "joblib", "tqdm"),
    ("ouster-sdk>=1.0", "more-itertools", "threadpoolctl"),
    ("projectaria-tools>=2.3",),
)
"""Libraries that read recordings outside, with what they import; not what their command lines and viewers need."""


@pytest.fixture(scope="session", autouse=True)
def types_read_once(request: pytest.FixtureRequest) -> Iterator[None]:
    """Definitions of messages are read once for all tests that open recordings; other tests load nothing for it."""
    if not any(item.get_closest_marker("integration") for item in request.session.items):
        yield
        return
    from tests.recordings import types_once  # noqa: PLC0415 - rosbags takes long to load

    with types_once.types_read_once():
        yield


@pytest.fixture(scope="session")
def outside_python() -> Path:
    """A program that runs Python with the libraries in :data:`OUTSIDE`."""

    def make(folder: Path) -> None:
        install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(folder / "packages")]
        subprocess.run([*install, *(name for names in OUTSIDE for name in names)], check=True, timeout=300)
        program = folder / "python"
        program.write_text(f'#!/bin/sh\nPYTHONPATH="$(dirname "$0")/packages:$PYTHONPATH" exec {sys.executable} "$@"\n')
        program.chmod(0o755)

    return made_once("outside", make) / "python"
