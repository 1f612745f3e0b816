"""The lock that allows one worker per data root and machine: runs of two workers would disturb each other."""

from __future__ import annotations

import fcntl
import os
import platform
import time
from pathlib import Path
from types import TracebackType
from typing import Self

from slamhive.clock import monotonic_s
from slamhive.errors import Conflict, Unavailable

PATIENCE_S = 1.0
"""How long a worker waits for those who only ask whether there is one."""
_STEP_S = 0.02


class WorkerLock:
    """An advisory lock, which the kernel releases when the process dies."""

    def __init__(self, data_root: Path) -> None:
        self.path = data_root / f"worker-{platform.node() or 'host'}.lock"
        self._descriptor: int | None = None

    def acquire(self) -> None:
        """Take the lock; raises Conflict if another worker holds it, Unavailable if the data root is not writable."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be opened: {error.strerror}", "check space and rights") from None
        if not _lock_patiently(descriptor):
            holder = os.pread(descriptor, 32, 0).decode(errors="replace").strip() or "unknown"
            os.close(descriptor)
            raise Conflict(
                f"a worker is already running on this machine (process {holder})",
                "it executes the queued runs; stop it before you start another",
            )
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        self._descriptor = descriptor

    def release(self) -> None:
        """Release the lock if it is held."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def held_elsewhere(self) -> bool:
        """Return whether a worker holds the lock now. Creates no file, so it works on a read-only data root."""
        try:
            descriptor = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            return False
        except OSError as error:
            raise Unavailable(f"{self.path} cannot be opened: {error.strerror}", "check rights") from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(descriptor)
        return False

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def _lock_patiently(descriptor: int) -> bool:
    """Try to take the lock for a short time: a process that only asks for it holds it for a moment."""
    deadline_s = monotonic_s() + PATIENCE_S
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if monotonic_s() >= deadline_s:
                return False
            time.sleep(_STEP_S)
        else:
            return True
