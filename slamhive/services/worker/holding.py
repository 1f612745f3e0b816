"""Hold on to runs and to the machine: the heartbeat that renews leases, and the lock of the one worker per data root.

A lease in the database protects a run from workers of other machines. The lock keeps a second worker off this machine,
where runs of two workers would disturb each other.
"""

from __future__ import annotations

import fcntl
import logging
import os
import platform
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import Conflict, SlamHiveError, Unavailable

if TYPE_CHECKING:
    from slamhive.services.worker.run_in_hand import HeldRuns
    from slamhive.store import Store

logger = logging.getLogger(__name__)

PATIENCE_S = 1.0
"""How long a worker waits for processes that only ask whether there is one."""
_STEP_S = 0.02


class Heartbeat:
    """Extends the leases of held runs, and notes which runs users want cancelled.

    Each lease is renewed three times while it lasts, so two renewals in a row may fail before a run is taken over.

    Args:
        held: The runs. A run that another worker has taken is removed from them.
        store: Keeps the leases.
        owner: Who holds the runs.
        lease_s: How long a lease lasts.
        interval_s: Time between two looks for cancelled runs.
    """

    def __init__(self, held: HeldRuns, store: Store, owner: str, lease_s: float, interval_s: float) -> None:
        self._held = held
        self._store = store
        self._owner = owner
        self._lease_s = lease_s
        self._interval_s = interval_s

    def beat(self, ends: threading.Event) -> None:
        """Go on until ``ends`` is set."""
        next_beat_s = 0.0
        while not ends.wait(self._interval_s):
            held = self._held.snapshot()
            if not held:
                continue
            try:
                if monotonic_s() >= next_beat_s:
                    next_beat_s = monotonic_s() + self._lease_s / 3
                    self._extend(held)
                self._held.cancel |= self._store.read(lambda t, held=held: t.queue.cancel_requested(held))  # type: ignore[misc]
            except SlamHiveError as error:
                logger.warning("heartbeat: %s", str(error))
            except Exception:
                # Without heartbeats, another worker would take over the runs of this one.
                logger.exception("internal error of the heartbeat; it continues")

    def _extend(self, held: set[int]) -> None:
        still = self._store.write(lambda t: t.queue.heartbeat(held, t.lease(self._owner, self._lease_s)))
        lost = held - still
        if lost:
            for run in self._store.read(lambda t: t.runs.get_many(lost)):
                if run.lease_owner != self._owner:
                    self._held.discard(run.id)


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
        # A process that only asks for the lock holds it for a moment.
        deadline_s = monotonic_s() + PATIENCE_S
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if monotonic_s() < deadline_s:
                    time.sleep(_STEP_S)
                    continue
                holder = os.pread(descriptor, 32, 0).decode(errors="replace").strip() or "unknown"
                os.close(descriptor)
                raise Conflict(
                    f"a worker is already running on this machine (process {holder})",
                    "it executes the queued runs; stop it before you start another",
                ) from None
        # Only under the lock: who is refused reads the number of the holder.
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
            # Shared, so that two that ask at once do not take each other for a worker.
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
