"""The CPU model of this machine, and which experiments it keeps from running here."""

from __future__ import annotations

import logging
from collections.abc import Callable

from slamhive.clock import monotonic_s
from slamhive.errors import SlamHiveError
from slamhive.executors.base import Executor
from slamhive.executors.host import describe_host
from slamhive.settings import Settings
from slamhive.store import Machine, Store

logger = logging.getLogger(__name__)

LOOK_EVERY_S = 30.0
ANY_CPU_HINT = "a worker on such a machine takes them; ANY_CPU=true lets this one do it"


class CpuType:
    """The CPU type that a worker names when it claims runs. Safe to share between threads.

    Args:
        settings: Whether workers here take runs that began on another CPU model.
        store: The queue.
        executors: The executor for a name.

    Attributes:
        machine: For the queue; None if any run may be taken.
    """

    def __init__(self, settings: Settings, store: Store, executors: Callable[[str], Executor]) -> None:
        self._store = store
        self._executors = executors
        self._told: set[str] = set()
        self._look_at_s = 0.0
        self.machine = None if settings.any_cpu else Machine(describe_host().cpu_model, self._is_elsewhere)

    def tell_what_waits(self) -> None:
        """Log once which experiments wait for another CPU model."""
        if self.machine is None or monotonic_s() < self._look_at_s:
            return
        self._look_at_s = monotonic_s() + LOOK_EVERY_S
        machine = self.machine
        for entry in self._store.read(lambda t: t.same_cpu.barred(machine)):
            if entry.name not in self._told:
                self._told.add(entry.name)
                wanted, here = entry.cpu_model, machine.cpu_model
                logger.warning("experiment %s stays on %s, this is %s: %s", entry.name, wanted, here, ANY_CPU_HINT)

    def _is_elsewhere(self, executor: str) -> bool:
        """Return whether the engine of an executor chooses the machine."""
        try:
            return not self._executors(executor).capabilities.takes_cores_here
        except SlamHiveError:
            return False  # whoever drives the run meets the same error, and ends the run with it
