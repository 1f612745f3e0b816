"""How long what has not ended of an experiment will take."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from slamhive.clock import monotonic_s
from slamhive.services.experiments.context import guessed_duration_s
from slamhive.store.durations import Pairing
from slamhive.store.experiment_records import ExperimentRecord
from slamhive.store.store import Transaction

MANY_RUNS = 5000
"""From here on the runs that wait are not looked at for every page: their mean changes slowly."""
KEPT_S = 60.0


@dataclass(frozen=True, slots=True)
class _Mean:
    of_run_s: float
    looked_at_s: float


class TimeLeft:
    """Estimates by the runs of the experiment itself, or by those of others, or by recordings.

    Of many runs the mean of one is kept for a minute, and only their number is new. Several threads may use it.

    Args:
        slots: Runs at a time.
        clock: Monotonic seconds.
    """

    def __init__(self, slots: int, clock: Callable[[], float] = monotonic_s) -> None:
        self._slots = slots
        self._clock = clock
        self._lock = threading.Lock()
        self._means: dict[int, _Mean] = {}

    def of(self, t: Transaction, record: ExperimentRecord, waiting: int) -> float:
        """Seconds until ``waiting`` runs of the experiment, all that have not ended, will have."""
        if not waiting:
            return 0.0
        now_s = self._clock()
        with self._lock:
            known = self._means.get(record.id)
        if known is None or waiting < MANY_RUNS or now_s - known.looked_at_s > KEPT_S:
            known = _Mean(_mean_s(t, record.id), now_s)
            with self._lock:
                self._means[record.id] = known
        return waiting * known.of_run_s / self._slots


def _mean_s(t: Transaction, experiment_id: int) -> float:
    """Of the runs that have not ended."""
    waiting = t.durations.unfinished(experiment_id)
    own, others = t.durations.of_pairings(experiment_id), t.durations.of_pairings()
    recordings_s = {dataset.name: dataset.duration_s for dataset in t.catalogue.datasets()}
    total_s = sum(count * _run_s(pairing, own, others, recordings_s) for pairing, count in waiting.items())
    return total_s / max(1, sum(waiting.values()))


def _run_s(
    pairing: Pairing, own: Mapping[Pairing, float], others: Mapping[Pairing, float], recordings_s: Mapping[str, float]
) -> float:
    measured_s = own.get(pairing, others.get(pairing))
    return guessed_duration_s(pairing, recordings_s[pairing[1]]) if measured_s is None else measured_s
