"""How long the rest of an experiment will take: builds, runs, what lies between them, and evaluations."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from slamhive.clock import SYSTEM_CLOCK, Clock
from slamhive.domain.numbers import plural
from slamhive.domain.remaining import Remaining
from slamhive.domain.run import RunState
from slamhive.services.experiments.expected import Costs, Expected, guessed_duration_s
from slamhive.store import Transaction
from slamhive.store.durations import ActiveRun, Pairing, Unfinished
from slamhive.store.experiment_records import ExperimentRecord

MANY_RUNS = 5000
"""From this many waiting runs on, the means are kept for a while: they change slowly and cost a look at each run."""
KEPT_S = 60.0
_OVERDUE = 4 / 3
"""What has taken longer than expected is expected to take so many times what it has taken."""


class Left(NamedTuple):
    """The time until everything has ended, and in words what happens now."""

    time: Remaining
    phase: str


@dataclass(frozen=True, slots=True)
class _Means:
    """``of_run``: of the runs that have not ended, from claim to end. Without ``measured``, none like them ran."""

    of_run: Expected
    of_evaluation: Expected
    of_build: Expected
    measured: bool
    unbuilt: tuple[str, ...]
    evaluated_fraction: float
    looked_at: float


class TimeLeft:
    """Estimates from the runs of the experiment itself, else from other runs, else from the recordings' durations.

    Several threads may use it.

    Args:
        slots: Runs at a time.
        clock: Says for how long runs have been under way.
    """

    def __init__(self, slots: int, clock: Clock = SYSTEM_CLOCK) -> None:
        self._slots = slots
        self._clock = clock
        self._lock = threading.Lock()
        self._means: dict[int, _Means] = {}

    def of(self, t: Transaction, record: ExperimentRecord, waiting: int) -> Left:
        """Until the ``waiting`` runs of the experiment have ended, and all its runs are evaluated."""
        evaluations = t.durations.open_evaluations(record.id)
        if not waiting and not evaluations:
            return Left(Remaining(0.0, 0.0, 0.0), "")
        means = self._known(record.id, waiting) or self._look(t, record.id)
        active = t.durations.active(record.id)
        building = {run.package: run for run in active if _builds(run, means)}
        running = [run for run in active if not _builds(run, means)]
        of_build = self._no_less(means.of_build, building.values())
        of_run = means.of_run if means.measured else self._no_less(means.of_run, running)
        built_s = sum(self._passed_s(building.get(name), of_build.seconds) for name in means.unbuilt)
        ran_s = sum(self._passed_s(run, of_run.seconds) for run in running)
        amount = (
            of_build.times(len(means.unbuilt), built_s)
            + of_run.times(waiting, ran_s)
            + means.of_evaluation.times(evaluations + waiting * means.evaluated_fraction)
        )
        time = amount.remaining(min(self._slots, max(waiting, evaluations)))
        measured = means.measured if waiting else not means.of_evaluation.guessed_s
        phase = _phase(active, tuple(building), evaluations) or _waiting(record.cpu_model)
        return Left(time if measured else Remaining(time.seconds), phase)

    def _no_less(self, expected: Expected, under_way: Iterable[ActiveRun]) -> Expected:
        """A guess that is no less than what takes longest now will take; what was measured stays."""
        longest_s = max((_OVERDUE * self._elapsed_s(run) for run in under_way), default=0.0)
        return Expected.guess(longest_s) if expected.guessed_s and longest_s > expected.seconds else expected

    def _passed_s(self, run: ActiveRun | None, expected_s: float) -> float:
        """How much of the expected time has passed; less than nothing of one that takes longer than expected.

        Such a run is taken to need a third of its time again: the longer it has taken, the further is its end.
        """
        elapsed_s = 0.0 if run is None else self._elapsed_s(run)
        return expected_s - max(expected_s - elapsed_s, (_OVERDUE - 1) * elapsed_s)

    def _elapsed_s(self, run: ActiveRun) -> float:
        return (self._clock.utc_now() - run.claimed_at).total_seconds()

    def _known(self, experiment_id: int, waiting: int) -> _Means | None:
        with self._lock:
            means = self._means.get(experiment_id)
        fresh = means is not None and waiting >= MANY_RUNS and self._clock.monotonic_s() - means.looked_at <= KEPT_S
        return means if fresh else None

    def _look(self, t: Transaction, experiment_id: int) -> _Means:
        waiting = t.durations.unfinished(experiment_id)
        runs = max(1, sum(count.runs for count in waiting.values()))
        costs = Costs.look(t)
        expected = _expected(t, experiment_id, waiting)
        means = _Means(
            of_run=Expected.mean(expected) + costs.overhead,
            of_evaluation=costs.evaluation,
            of_build=costs.build,
            measured=any(not each.guessed_s for _, each in expected),
            unbuilt=tuple(t.durations.unbuilt(experiment_id)),
            evaluated_fraction=sum(count.to_evaluate for count in waiting.values()) / runs,
            looked_at=self._clock.monotonic_s(),
        )
        with self._lock:
            self._means[experiment_id] = means
        return means


def _builds(run: ActiveRun, means: _Means) -> bool:
    return run.state is RunState.PREPARING and run.package in means.unbuilt


def _phase(active: Sequence[ActiveRun], building: Sequence[str], evaluations: int) -> str:
    """What happens now: ``building aloam, 2 runs under way, 3 evaluations to do``; empty for nothing."""
    under_way = [run for run in active if run.state is not RunState.PREPARING]
    preparing = len(active) - len(under_way) - len(building)
    parts = [f"building {', '.join(building)}"] if building else []
    parts += [f"preparing {plural(preparing, 'run')}"] if preparing > 0 else []
    parts += [f"{plural(len(under_way), 'run')} under way"] if under_way else []
    parts += [f"{plural(evaluations, 'evaluation')} to do"] if evaluations else []
    return ", ".join(parts)


def _waiting(cpu_model: str | None) -> str:
    return f"waiting for a worker, runs stay on {cpu_model}" if cpu_model else "waiting for a worker"


def _expected(t: Transaction, experiment_id: int, waiting: Mapping[Pairing, Unfinished]) -> list[tuple[int, Expected]]:
    """How many runs have not ended, and how long each takes from start to end, by what they run on what."""
    own, others = t.durations.of_pairings(experiment_id), t.durations.of_pairings()
    recordings_s = {dataset.name: dataset.duration_s for dataset in t.catalogue.datasets()}
    found = []
    for pairing, count in waiting.items():
        measured = own.get(pairing, others.get(pairing))
        if measured is None:
            found.append((count.runs, Expected.guess(guessed_duration_s(pairing, recordings_s[pairing[1]]))))
        else:
            found.append((count.runs, Expected.of(measured)))
    return found
