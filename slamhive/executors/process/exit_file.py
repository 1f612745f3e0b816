"""Reaps processes, and records how one ended, even on a full disk: the space is reserved before the process starts."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

EXIT_FILE = "exit.json"
_RESERVED = "exit.reserved"
_ROOM_BYTES = 16_384
MOST_LOST_BYTES = 2000
"""So much of the output that found no room in the log is kept."""


def reserve(work: Path) -> None:
    """Reserve the space of ``exit.json``. Raises OSError."""
    with (work / _RESERVED).open("wb") as stream:
        stream.write(b" " * _ROOM_BYTES)
        stream.flush()
        os.fsync(stream.fileno())


def write_exit(work: Path, content: dict[str, Any]) -> None:
    """Write ``content`` into the reserved space, then rename it: a reader sees all of it or nothing."""
    data = json.dumps(content).encode().ljust(_ROOM_BYTES)
    with (work / _RESERVED).open("r+b") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    (work / _RESERVED).replace(work / EXIT_FILE)


def reap() -> Iterator[tuple[int, int]]:
    """Reap the children that have ended: pid and wait status of each."""
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if pid == 0:
            return
        yield pid, status


class LostOutput:
    """The end of what was printed while the log could not be written."""

    def __init__(self) -> None:
        self._tail = b""
        self._why = ""

    def add(self, data: bytes, why: str) -> None:
        """``data`` was not written."""
        self._tail = (self._tail + data)[-MOST_LOST_BYTES:]
        self._why = why

    @property
    def text(self) -> str:
        """Why output is missing, and its end; empty if none is."""
        return f"[output was lost: {self._why}; its end:]\n{self._tail.decode(errors='replace')}" if self._why else ""
