"""Watch a running run: sample it, and end it at its limits, by its stop rules, or when the user cancels it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from typing import Any

from slamhive.domain.run import RunState
from slamhive.executors.gpu import GpuLog
from slamhive.executors.host_counters import POWERCAP, EnergyLog, HostCounters, HostReader
from slamhive.executors.host_log import HostLog, HostReading
from slamhive.executors.sampler import MachineLogs, Sampler
from slamhive.executors.status import Gone, Running
from slamhive.run_folder.outcome import Observation, broken_rule, is_finished
from slamhive.services.runs import untracked_s
from slamhive.services.worker.evidence import (
    DISK_LIMIT,
    ENGINE_AWAY,
    STOP_RULE,
    STOPPED_BECAUSE,
    DiskWatch,
    disk_limits,
)
from slamhive.services.worker.run_in_hand import CANCELLED_BY_USER, RunInHand
from slamhive.store.records import LeaseLost

LINGER_S = 10.0
"""How long an algorithm may take to exit after ``finished`` before it is stopped; its result counts."""

_ENDINGS = {
    "timeout": "time limit reached",
    "disk_limit": "disk limit reached",
    "process_limit": "limit of processes reached",
    "linger": "finished",
    "stop_when": "ended early",
}

_AT_ONCE = frozenset({"disk_limit", "process_limit"})
"""Endings after which the run is killed at once."""


class Watch:
    """Watches one run until it has ended or the user cancels it."""

    def __init__(self, hand: RunInHand) -> None:
        self._hand = hand
        self._sampler: Sampler | None = None
        self._finished_at: datetime | None = None

    def watch(self) -> None:
        """Move the run to ``collecting`` or ``cancelling``."""
        with self._sampled() as sampled:
            cause = self._wait_for_end()
        if cause == "cancelled":
            self._hand.move(RunState.CANCELLING, CANCELLED_BY_USER, record=sampled)
            return
        stopped_because = self._hand.saved().get(STOPPED_BECAUSE, cause)
        self._hand.move(RunState.COLLECTING, _ENDINGS.get(stopped_because, stopped_because), record=sampled)

    @contextmanager
    def _sampled(self) -> Iterator[dict[str, Any]]:
        """Sample during the block; yields what the record is to hold of it, filled in once the block has ended."""
        hand = self._hand
        found: dict[str, Any] = {}
        source = hand.executor.usage_source(hand.handle)
        if source is None:
            yield found
            return
        interval_s = hand.context.settings.sample_interval_s
        offset_s, here = max(0.0, hand.elapsed_s()), source.on_this_machine
        energy = EnergyLog(hand.folder.energy, POWERCAP if here else None)

        def ask_executor(_time_s: float, _run_cpu_s: float) -> HostReading | None:
            return hand.executor.host_reading(hand.handle)

        reader = HostReader(HostCounters(hand.spec.limits.cpuset)).read if here else ask_executor
        gpu = hand.saved().get("gpu")
        use = None if gpu is None else GpuLog(hand.folder.gpu, lambda: hand.executor.gpu_use(hand.handle, gpu["uuid"]))
        machine = MachineLogs(energy, HostLog(hand.folder.host, reader), use)
        self._sampler = Sampler(source, hand.folder.profiling, interval_s, offset_s=offset_s, machine=machine)
        self._sampler.start()
        moves = False
        try:
            yield found
            moves = True
        finally:
            if totals := self._sampler.stop():
                found["kernel_totals"] = totals
            if found and not moves:
                with suppress(LeaseLost):  # then the totals that the new holder of the run sees count
                    hand.save(found)

    def _wait_for_end(self) -> str:
        """Return ``exited``, ``gone``, ``cancelled``, or the value to store under :data:`STOPPED_BECAUSE`."""
        hand = self._hand
        saved = hand.saved()
        disk = DiskWatch(hand, disk_limits(saved))
        engine_was_away = ENGINE_AWAY in saved
        while True:
            status = hand.executor.poll(hand.handle)
            if not isinstance(status, Running):
                return "gone" if isinstance(status, Gone) else "exited"
            if engine_was_away:
                # The run has outlived the absence of its engine: from now on, its exit code is its own.
                hand.save({}, without=ENGINE_AWAY)
                engine_was_away = False
            if hand.cancel_requested():
                return "cancelled"
            if STOPPED_BECAUSE in saved:
                # A worker recorded why and died before it stopped the run; the cause may have passed by now.
                return self._stop(saved[STOPPED_BECAUSE])
            hand.executor.refresh(hand.spec, hand.handle)
            cause = {STOPPED_BECAUSE: "process_limit"} if status.process_limit else self._cause_to_stop(status, disk)
            if cause is not None:
                # Record the reason before the stop, so that the exit code is not blamed on the algorithm.
                hand.save(cause)
                return self._stop(cause[STOPPED_BECAUSE])
            hand.check_still_ours()
            hand.context.stopping.wait(hand.context.settings.poll_interval_s)

    def _cause_to_stop(self, status: Running, disk: DiskWatch) -> dict[str, Any] | None:
        """Return the record entries that say why the run must stop now; None if it may continue."""
        hand = self._hand
        if status.delivering:
            return None
        # A node that cannot be asked may have ended the run since: count the time up to the last sign of it.
        seen_s = hand.elapsed_s() if status.as_of is None else (status.as_of - hand.started_at).total_seconds()
        if seen_s > hand.spec.timeout_s:
            return {STOPPED_BECAUSE: "timeout"}
        exceeded = disk.exceeded()
        if exceeded is not None:
            return {STOPPED_BECAUSE: "disk_limit", DISK_LIMIT: exceeded}
        if self._finished_at is None and is_finished(hand.folder.finished):
            self._finished_at = hand.context.now()
        if self._finished_at is not None:
            # The result is complete: there is nothing to end early.
            lingered_s = (hand.context.now() - self._finished_at).total_seconds()
            return {STOPPED_BECAUSE: "linger"} if lingered_s > LINGER_S else None
        rules = hand.run.stop_when
        observation = Observation(
            elapsed_s=hand.elapsed_s(),
            memory_bytes=None if self._sampler is None else self._sampler.most_bytes,
            untracked_s=untracked_s(hand.folder) if rules.lost_tracking_s is not None else None,
        )
        broken = broken_rule(rules, observation)
        if broken is None:
            return None
        return {STOPPED_BECAUSE: "stop_when", STOP_RULE: {"reason": broken.reason.value, "detail": broken.detail}}

    def _stop(self, cause: str) -> str:
        # A run that fills the disk or forks would continue during a grace period.
        grace_s = 0.0 if cause in _AT_ONCE else self._hand.context.settings.stop_grace_s
        self._hand.executor.stop(self._hand.handle, grace_s)
        return cause
