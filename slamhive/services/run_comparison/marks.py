"""Which metrics of a comparison are marked as better: those of runs that differ in nothing that explains them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from slamhive.domain.metrics import Metric
from slamhive.domain.numbers import plural
from slamhive.store.records import RunRecord


class Part(StrEnum):
    """A part of the metrics, as sentences name it."""

    ALL = "nothing"
    ACCURACY = "no accuracy"
    MEASURED = "no CPU, memory or time"


@dataclass(frozen=True, slots=True)
class Unmarked:
    """Why no metric of a part is marked."""

    part: Part
    why: str

    @property
    def words(self) -> str:
        """The same as the end of a line: ``nothing is marked as better: the runs are of 2 datasets``."""
        return f"{self.part} is marked as better: {self.why}"

    def holds_for(self, metric: Metric) -> bool:
        """Whether ``metric`` belongs to the part."""
        return self.part is Part.ALL or metric.needs_protocol is (self.part is Part.ACCURACY)


def unmarked_parts(runs: Sequence[RunRecord], *, mixed_trajectories: bool) -> tuple[Unmarked, ...]:
    """The parts of the metrics in which the runs cannot be compared.

    Args:
        runs: All runs of the comparison.
        mixed_trajectories: Whether live, final and keyframe trajectories were judged.
    """
    datasets = {run.dataset for run in runs}
    if len(datasets) > 1:
        return (Unmarked(Part.ALL, f"the runs are of {len(datasets)} datasets"),)
    models = {run.host.cpu_model for run in runs if run.host is not None}
    accuracy = (Unmarked(Part.ACCURACY, "kinds of trajectories are mixed"),) if mixed_trajectories else ()
    measured = (Unmarked(Part.MEASURED, f"the runs are of {plural(len(models), 'CPU model')}"),)
    return accuracy + (measured if len(models) > 1 else ())
