"""Reaps processes, and records how one ended, even on a full disk: the space is reserved before the process starts."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

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


# A log with a size limit: it keeps the beginning and the end, and leaves out the middle.


class CappedLog:
    """Writes output into a folder: ``head`` until half of the limit, then two files by turns, a quarter each.

    Everything is on disk at once, so that a killed writer loses nothing; :func:`assemble` makes one text of it.
    """

    def __init__(self, folder: Path, limit_bytes: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._head_left = limit_bytes // 2
        self._part_limit = max(1, limit_bytes // 4)
        self._left_out = 0
        self._part = 0
        self._stream: IO[bytes] = (folder / "head").open("wb", buffering=0)

    def write(self, data: bytes) -> None:
        """Append ``data``."""
        head, rest = data[: self._head_left], data[self._head_left :]
        if head:
            self._stream.write(head)
            self._head_left -= len(head)
        while rest:
            if self._part == 0 or self._stream.tell() >= self._part_limit:
                # Only the newest two parts stay; the size of those before is added to what was left out.
                self._stream.close()
                self._part += 1
                old = self._folder / f"part-{self._part - 2}"
                if old.exists():
                    self._left_out += old.stat().st_size
                    old.unlink()
                    (self._folder / "left-out").write_text(str(self._left_out), encoding="ascii")
                self._stream = (self._folder / f"part-{self._part}").open("wb", buffering=0)
            room = self._part_limit - self._stream.tell()
            self._stream.write(rest[:room])
            rest = rest[room:]

    def close(self) -> None:
        """Close the file in use."""
        self._stream.close()


def assemble(folder: Path) -> bytes:
    """The whole text of a log folder, with a line that says how much of the middle is missing."""
    parts = sorted(folder.glob("part-*"), key=lambda path: int(path.name.partition("-")[2]))
    pieces = [_read(folder / "head")]
    left_out = _read(folder / "left-out").decode()
    if left_out:
        pieces.append(f"\n[... {left_out} bytes left out ...]\n".encode())
    pieces += [_read(part) for part in parts]
    return b"".join(pieces)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return b""
