"""The server of the downloads."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.downloads.file_server import FileServer, serving


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    """A server that no proxy of the environment stands before."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with serving() as files:
        yield files
