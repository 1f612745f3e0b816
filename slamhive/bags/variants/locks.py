"""Locks files between processes, shared or exclusive; the kernel releases them when the process ends."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slamhive.bags.staging import Progress
from slamhive.errors import Unavailable

POLL_S = 0.05


class Busy(Exception):
    """Another process holds the lock."""


@contextmanager
def shared(path: Path, waiting: Progress) -> Iterator[None]:
    """Hold the lock together with others; ``waiting`` is called while another process holds it exclusively."""
    with _held(path, fcntl.LOCK_SH, waiting):
        yield


@contextmanager
def exclusive(path: Path, waiting: Progress | None = None) -> Iterator[None]:
    """Hold the lock exclusively; ``waiting`` is called while others hold it. Without it, raise Busy at once."""
    with _held(path, fcntl.LOCK_EX, waiting):
        yield


def is_held(path: Path) -> bool:
    """Whether any process holds the lock now; creates no file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


@contextmanager
def _held(path: Path, kind: int, waiting: Progress | None) -> Iterator[None]:
    descriptor = _take(path, kind)
    while descriptor is None:
        if waiting is None:
            raise Busy(str(path))
        waiting(0.0, "waiting for another process")
        time.sleep(POLL_S)
        descriptor = _take(path, kind)
    try:
        yield
    finally:
        os.close(descriptor)


def _take(path: Path, kind: int) -> int | None:
    """Try to take the lock; returns its descriptor or None."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise Unavailable(f"{path} cannot be opened: {error.strerror}", "check space and rights") from None
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        # The last holder may have removed the file meanwhile; a lock on what nobody else can open is worth nothing.
        if os.path.samestat(os.fstat(descriptor), path.stat()):
            return descriptor
    except (BlockingIOError, FileNotFoundError):
        pass
    os.close(descriptor)
    return None
