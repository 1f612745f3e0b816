"""Files of the ledger: JSON lines that any process appends to, sometimes replaced as a whole."""

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

from slamhive.base.errors import Unavailable
from slamhive.base.files import make_shared_folder, remedy_of, write_aside

logger = logging.getLogger(__name__)

Line = dict[str, Any]
"""An object. A value that is an iterator is written as a list, entry by entry, to save memory."""

_encode = json.JSONEncoder(allow_nan=False, separators=(",", ":")).encode


class Book:
    """A file of lines. Readers skip a line that a kill or a full disk has truncated.

    Args:
        path: The file, created with its first line.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, lines: Iterable[Line]) -> None:
        """Append lines, all or none; raises Unavailable."""
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
        """All complete lines, oldest first; raises Unavailable."""
        try:
            with self.path.open("rb") as stream:
                for number, text in enumerate(stream, start=1):
                    line = _decoded(text)
                    if line is not None:
                        yield line
                    elif text.strip():
                        logger.warning("line %d of %s is incomplete and is skipped", number, self.path)
        except FileNotFoundError:
            return
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be read: {error.strerror}", "check rights") from None

    @contextmanager
    def replaced(self) -> Iterator[list[Line]]:
        """Lock the file for the block, then replace its lines by those of the yielded list."""
        lines: list[Line] = []
        try:
            with self._held() as descriptor:
                yield lines
                write_aside(self.path, "".join(map(_text, lines)), stat.S_IMODE(os.fstat(descriptor).st_mode))
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be written: {error.strerror}", remedy_of(error)) from None

    @contextmanager
    def _held(self) -> Iterator[int]:
        """The file, open and locked; the kernel releases the lock when the process dies."""
        while True:
            descriptor = self._open()
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX)
                try:
                    same = os.path.samestat(os.fstat(descriptor), os.lstat(self.path))
                except FileNotFoundError:
                    same = False
                if not same:
                    continue  # replaced while this process waited for the lock
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
            # A web server and a worker of different users share the folder through its group.
            if self.path.parent.stat().st_mode & stat.S_IWGRP:
                os.fchmod(descriptor, 0o664)
            return descriptor


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


class LedgerFiles:
    """``<data>/ledger/``.

    Args:
        folder: The folder, created with its first line.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def configurations(self) -> Book:
        """Configurations with their numbers, labels, and deletions."""
        return Book(self.folder / "configurations.jsonl")

    @property
    def runs(self) -> Book:
        """Queued runs, and cancellations."""
        return Book(self.folder / "runs.jsonl")

    @property
    def cells(self) -> Book:
        """Cells of experiments, and the number of cells and runs of each."""
        return Book(self.folder / "cells.jsonl")

    @property
    def evaluations(self) -> Book:
        """Requested evaluations, and how they ended."""
        return Book(self.folder / "evaluations.jsonl")

    @property
    def catalogue(self) -> Book:
        """Algorithms with their versions, and datasets; a small file that is always replaced."""
        return Book(self.folder / "catalogue.jsonl")

    @property
    def searches(self) -> Book:
        """Saved searches; a small file that is always replaced."""
        return Book(self.folder / "searches.jsonl")
