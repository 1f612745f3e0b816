"""Choose the next run of a slot and its place: same data first, for a while; only engines that answer and have room.

The order among queued runs is described in ``docs/how-a-run-works.md``.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import SlamHiveError
from slamhive.base.settings import Settings
from slamhive.base.tree import remove_tree
from slamhive.domain.placement import same_data
from slamhive.executors.base import EngineUnavailable, Executor
from slamhive.executors.host import describe_host
from slamhive.executors.spec import Placing, RunSpec
from slamhive.executors.status import RunHandle
from slamhive.services.experiments import guessed_duration_s
from slamhive.services.worker.run_in_hand import RunInHand
from slamhive.store import MeasuredMachine, Store, Transaction
from slamhive.store.durations import NODE, NodeSeen
from slamhive.store.records import RunRecord

logger = logging.getLogger(__name__)

LOOK_EVERY_S = 30.0
ANY_CPU_HINT = "a worker on such a machine takes them; ANY_CPU=true lets this one do it"

MOST_IN_A_ROW = 20
"""After this many runs on the same data, the oldest run in the queue is next."""


class Turns:
    """Remembers the latest runs of one slot."""

    def __init__(self) -> None:
        self._affinity = ""
        self._in_a_row = 0

    @property
    def near(self) -> str:
        """The preferred affinity of the next run; empty if the oldest run is due."""
        return self._affinity if self._in_a_row < MOST_IN_A_ROW else ""

    def took(self, run: RunRecord) -> None:
        """Note that the slot has claimed ``run``."""
        asked = self.near
        again = bool(asked) and bool(run.affinity) and same_data(asked) == same_data(run.affinity)
        self._in_a_row = self._in_a_row + 1 if again else 1
        self._affinity = run.affinity


class AbsentExecutors:
    """Executors that do not answer: their runs stay in the queue, others continue. Thread-safe.

    Args:
        executors: The executor for a name.
        pause_s: Time before an executor is asked again.
        clock: Monotonic seconds.
    """

    def __init__(
        self, executors: Callable[[str], Executor], pause_s: float, clock: Callable[[], float] = monotonic_s
    ) -> None:
        self._executors = executors
        self._pause_s = pause_s
        self._clock = clock
        self._lock = threading.Lock()
        self._ask_at_s: dict[str, float] = {}

    def note(self, name: str) -> None:
        """Note that the executor ``name`` does not answer."""
        with self._lock:
            self._ask_at_s[name] = self._clock() + self._pause_s

    def names(self) -> tuple[str, ...]:
        """The executors that still do not answer; asks those whose pause is over."""
        with self._lock:
            due = [name for name, at_s in self._ask_at_s.items() if self._clock() >= at_s]
        for name in due:
            if self._executors(name).unavailable_because() is None:
                with self._lock:
                    self._ask_at_s.pop(name, None)
            else:
                self.note(name)
        with self._lock:
            return tuple(sorted(self._ask_at_s))


class OneAtATime:
    """Lets one run at a time use an executor that cannot have several. Safe to share between threads.

    Args:
        executors: The executor for a name.
    """

    def __init__(self, executors: Callable[[str], Executor]) -> None:
        self._executors = executors
        self._lock = threading.Lock()
        self._turns: dict[str, threading.Lock] = {}

    def busy(self) -> tuple[str, ...]:
        """The executors whose only place is taken."""
        with self._lock:
            return tuple(sorted(name for name, turn in self._turns.items() if turn.locked()))

    def turn(self, name: str) -> AbstractContextManager[Any]:
        """Return a lock to hold while a run uses the executor ``name``: the second of two slots waits here."""
        try:
            several = self._executors(name).capabilities.several_at_once
        except SlamHiveError:
            several = True  # whoever drives the run meets the same error, and ends the run with it
        if several:
            return nullcontext()
        with self._lock:
            return self._turns.setdefault(name, threading.Lock())


def place(hand: RunInHand) -> RunSpec:
    """Return the specification of a run with hints about the node to start it on.

    A run stays on the CPU model of its experiment and near its data; long runs start first.
    """
    spec = hand.spec
    if hand.executor.capabilities.takes_cores_here:
        return spec
    any_cpu, refused = hand.context.settings.any_cpu, hand.context.other_cpus.of(hand.run.executor)

    def look(t: Transaction) -> Placing:
        wanted = None if any_cpu or hand.run.experiment_id is None else t.same_cpu.known(hand.run.experiment_id)
        run = hand.run
        expected_s = t.placing.measured_s(run.configuration_id)
        if expected_s is None:
            pairing = (run.algorithm, run.dataset, run.playback.mode, run.playback.rate)
            expected_s = guessed_duration_s(pairing, t.placing.recording_s(run.dataset))
        return placing_of(wanted, t.placing.seen(run.executor), refused, run.affinity, expected_s)

    return replace(spec, placing=hand.context.store.read(look))


def placing_of(
    cpu_model: str | None, seen: Sequence[NodeSeen], refused: Mapping[str, str], affinity: str, expected_s: float | None
) -> Placing:
    """Return the hints of a run.

    Args:
        cpu_model: What its node must have; None if any will do.
        seen: Where the latest runs were, the newest first: a node may have got another processor since.
        refused: {node: CPU model} of nodes that a run has just left again.
        affinity: Of the run.
        expected_s: How long it is expected to take.
    """
    models: dict[str, str] = {}
    for entry in seen:
        models.setdefault(entry.node, entry.cpu_model)
    models.update(refused)
    others = {node for node, model in models.items() if cpu_model is not None and model != cpu_model}
    near = {entry.node for entry in seen if affinity and same_data(entry.affinity) == same_data(affinity)}
    return Placing(cpu_model, tuple(sorted(others)), tuple(sorted(near - others)), expected_s)


def leave_other_cpu(hand: RunInHand, spec: RunSpec, handle: RunHandle) -> None:
    """End a run that has just started on a node with another CPU model, so that it starts again elsewhere.

    Nothing of it counts: its files are removed, and its next start names the node as one to avoid. Raises
    EngineUnavailable in that case.
    """
    wanted, host = spec.placing.cpu_model, handle.host
    if wanted is None or host is None or host.cpu_model == wanted:
        return
    node = str(handle.data.get(NODE, "unknown"))
    hand.context.other_cpus.note(hand.run.executor, node, host.cpu_model)
    hand.executor.remove(handle)
    with contextlib.suppress(OSError):  # the next start writes the same files
        remove_tree(hand.folder.result)
    hand.folder.create()
    why = f"run {hand.run.id} came to node {node} with {host.cpu_model}, and its experiment stays on {wanted}"
    raise EngineUnavailable(why, "it starts again on another node")


class CpuType:
    """CPU type that a worker names when it claims runs, and the experiments that it thereby keeps away. Thread-safe.

    Args:
        settings: Whether workers here take runs that began on another CPU model.
        store: The queue.
        executors: The executor for a name. Runs of an engine that chooses the machine may be taken anywhere.

    Attributes:
        machine: For the queue; None if any run may be taken.
    """

    def __init__(self, settings: Settings, store: Store, executors: Callable[[str], Executor]) -> None:
        self._store = store
        self._executors = executors
        self._told: set[str] = set()
        self._look_at_s = 0.0
        self.machine = None if settings.any_cpu else MeasuredMachine(describe_host().cpu_model, self._is_elsewhere)

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
