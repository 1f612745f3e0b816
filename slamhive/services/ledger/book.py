"""One file of the ledger: a JSON object a line, added to by any process, replaced as a whole now and then."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slamhive.errors import Unavailable
from slamhive.files import make_shared_folder, remedy_of, write_aside

logger = logging.getLogger(__name__)

Line = dict[str, Any]
"""An object. A value that is an iterator becomes a list, entry by entry: thousands of them are never there together."""

_encode = json.JSONEncoder(allow_nan=False, separators=(",", ":")).encode


class Book:
    """A file of lines. A line that a kill or a full disk cut off is passed over by whoever reads.

    Args:
        path: The file; it is made with its first line.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, lines: Iterable[Line]) -> None:
        """Add lines, all or none; raises Unavailable."""
        text = "".join(map(_text, lines)).encode()
        if not text:
            return
        try:
            with self._held() as descriptor:
                end = os.lseek(descriptor, 0, os.SEEK_END)
                cut_off = end > 0 and os.pread(descriptor, 1, end - 1) != b"\n"
                try:
                    _write(descriptor, b"\n" + text if cut_off else text)
                    os.fsync(descriptor)
                except OSError:
                    os.ftruncate(descriptor, end)
                    raise
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be written: {error.strerror}", remedy_of(error)) from None

    def read(self) -> Iterator[Line]:
        """All whole lines, the oldest first; raises Unavailable."""
        try:
            with self.path.open("rb") as stream:
                for number, text in enumerate(stream, start=1):
                    line = _decoded(text)
                    if line is not None:
                        yield line
                    elif text.strip():
                        logger.warning("line %d of %s is not whole and is passed over", number, self.path)
        except FileNotFoundError:
            return
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be read: {error.strerror}", "check rights") from None

    @contextmanager
    def replaced(self) -> Iterator[list[Line]]:
        """Nobody adds a line during the block; what the yielded list holds then takes the place of all lines."""
        lines: list[Line] = []
        try:
            with self._held() as descriptor:
                yield lines
                write_aside(self.path, "".join(map(_text, lines)), stat.S_IMODE(os.fstat(descriptor).st_mode))
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be written: {error.strerror}", remedy_of(error)) from None

    @contextmanager
    def _held(self) -> Iterator[int]:
        """The file, open and locked; the kernel lets go of the lock when its process dies."""
        while True:
            descriptor = self._open()
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX)
                if not self._is(descriptor):
                    continue  # replaced while the lock was waited for
                yield descriptor
                return
            finally:
                os.close(descriptor)

    def _open(self) -> int:
        make_shared_folder(self.path.parent)
        flags = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            return os.open(self.path, flags)
        except FileNotFoundError:
            descriptor = os.open(self.path, flags | os.O_CREAT, 0o644)
            # A web server and a worker that run as different users share the folder through its group.
            if self.path.parent.stat().st_mode & stat.S_IWGRP:
                os.fchmod(descriptor, 0o664)
            return descriptor

    def _is(self, descriptor: int) -> bool:
        try:
            return os.path.samestat(os.fstat(descriptor), os.lstat(self.path))
        except FileNotFoundError:
            return False


def _text(line: Line) -> str:
    parts = []
    for key, value in line.items():
        encoded = f"[{','.join(map(_encode, value))}]" if isinstance(value, Iterator) else _encode(value)
        parts.append(f"{_encode(key)}:{encoded}")
    return f"{{{','.join(parts)}}}\n"


def _write(descriptor: int, text: bytes) -> None:
    view = memoryview(text)
    while view:
        view = view[os.write(descriptor, view) :]


def _decoded(text: bytes) -> Line | None:
    try:
        line = json.loads(text)
    except ValueError:
        return None
    return line if isinstance(line, dict) else None
