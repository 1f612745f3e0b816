"""Extend the leases of the runs that a worker holds, and note those that users want cancelled."""

from __future__ import annotations

import logging
import threading

from slamhive.clock import monotonic_s
from slamhive.errors import SlamHiveError
from slamhive.services.worker.held_runs import HeldRuns
from slamhive.store import Store

logger = logging.getLogger(__name__)


class Heartbeat:
    """Extends each lease three times while it lasts.

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
