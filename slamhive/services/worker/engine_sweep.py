"""Remove what ended runs and dead processes have left in executors, such as containers.

A start of the worker alone is not enough: an engine may finish what a killed worker asked for after the next worker
has started.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from slamhive.clock import monotonic_s
from slamhive.domain.run import RunState
from slamhive.errors import SlamHiveError
from slamhive.executors.base import Executor
from slamhive.executors.registry import candidates
from slamhive.search.build import matching
from slamhive.store import Store
from slamhive.store.records import RunRecord

logger = logging.getLogger(__name__)

INTERVAL_S = 60.0
MOST_ACTIVE = 1000


class EngineSweep:
    """Sweeps the executors that active runs use, and those that the settings allow. Safe to share between threads.

    Args:
        setting: The executor of the settings, or ``auto``.
        store: Knows the active runs.
        executors: The executor for a name.
        interval_s: Time between two sweeps of :meth:`sweep_if_due`.
        elsewhere: The settings allow executors of other machines only.
    """

    def __init__(
        self,
        setting: str,
        store: Store,
        executors: Callable[[str], Executor],
        interval_s: float = INTERVAL_S,
        *,
        elsewhere: bool = False,
    ) -> None:
        self._setting = setting
        self._elsewhere = elsewhere
        self._store = store
        self._executors = executors
        self._interval_s = interval_s
        self._lock = threading.Lock()
        self._due_s = 0.0
        self._failures: dict[str, str] = {}

    def sweep_if_due(self) -> None:
        """Sweep unless another thread does so now, or the last sweep is less than the interval ago."""
        if monotonic_s() < self._due_s or not self._lock.acquire(blocking=False):
            return
        try:
            self._sweep()
        finally:
            self._lock.release()

    def sweep(self) -> None:
        """Sweep now."""
        with self._lock:
            self._sweep()

    def _sweep(self) -> None:
        self._due_s = monotonic_s() + self._interval_s
        names = {record.executor for record in self._active()}
        allowed = candidates(self._setting, self._executors, elsewhere=self._elsewhere)
        names.update(executor.name for executor in allowed)
        for name in sorted(names):
            try:
                removed = self._executors(name).sweep(self._live_keys)
            except SlamHiveError as error:
                if self._failures.get(name) != str(error):
                    logger.info("what runs have left in %s is not removed now: %s", name, error)
                self._failures[name] = str(error)
            else:
                self._failures.pop(name, None)
                if removed:
                    logger.info("removed %s, which nobody needs any more", ", ".join(removed))

    def _live_keys(self) -> set[str]:
        return {record.uid for record in self._active()}

    def _active(self) -> tuple[RunRecord, ...]:
        active = matching(states=tuple(state for state in RunState if state.active))
        return self._store.read(lambda t: t.runs.page(active, limit=MOST_ACTIVE)).records
