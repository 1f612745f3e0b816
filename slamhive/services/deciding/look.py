"""One look at an experiment that chooses its runs, from which everything follows."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from slamhive.domain.question import RunBudget
from slamhive.domain.run import FailureReason, RunState
from slamhive.experiments.experiment import Experiment, ExperimentCandidate, candidates_of
from slamhive.experiments.file import parse_experiment
from slamhive.store import Transaction
from slamhive.store.records import CellRun, ExperimentRecord


class RunUse(StrEnum):
    """Use of a run for its candidate. One that was cancelled or lost says nothing, and another takes its place."""

    OPEN = "open"
    GOOD = "good"
    FAILED = "failed"
    NOTHING = "nothing"
    CANNOT_RUN = "cannot run"


@dataclass(frozen=True, slots=True)
class ObservedRun:
    """A run of a candidate; ``metrics`` under the protocol of most runs on its dataset.

    ``failure`` is why it counts as failed, in words; None for another run.
    """

    id: int
    use: RunUse
    cancelled: bool
    reason: FailureReason | None
    metrics: Mapping[str, float]
    disturbed: bool = False
    failure: str | None = None


@dataclass(frozen=True, slots=True)
class QuestionLook:
    """One moment of an experiment.

    ``runs``: by cell, in the order in which they were asked for, without those that another replaced. ``asked`` counts
    them all, and they took ``spent_s`` together. ``looked`` of them are first looks at a clip.
    """

    record: ExperimentRecord
    experiment: Experiment
    candidates: tuple[ExperimentCandidate, ...]
    runs: Mapping[int, Sequence[ObservedRun]]
    asked: int
    spent_s: float
    looked: int = 0

    @property
    def datasets(self) -> tuple[str, ...]:
        """The datasets, in the order of the file."""
        return tuple(self.candidates[0].cells)

    @property
    def combinations(self) -> int:
        """The number of pairs of a candidate and a dataset."""
        return len(self.candidates) * len(self.datasets)

    @property
    def fingerprint(self) -> bytes:
        """Identifies all that the next step follows from."""
        runs = [
            (
                *(cell, run.id, run.use, run.cancelled, run.reason, sorted(run.metrics.items())),
                *(run.disturbed, run.failure),
            )
            for cell, runs in sorted(self.runs.items())
            for run in runs
        ]
        told = repr((self.record.uid, self.experiment.content_hash, self.asked, self.spent_s, runs))
        return hashlib.sha256(told.encode()).digest()

    def results(self, cell: int) -> list[ObservedRun]:
        """The runs of a cell that say something, in order."""
        return [run for run in self.runs.get(cell, ()) if run.use in (RunUse.GOOD, RunUse.FAILED)]

    def of(self, candidate: ExperimentCandidate) -> list[ObservedRun]:
        """The runs of a candidate on whole recordings."""
        return [run for cell in candidate.cells.values() for run in self.runs.get(cell, ())]

    def looks_of(self, candidate: ExperimentCandidate) -> list[ObservedRun]:
        """The first looks at a candidate, each at a clip."""
        return [run for cell in candidate.looks.values() for run in self.runs.get(cell, ())]

    def runs_left(self, budget: RunBudget) -> int:
        """Number of further runs on whole recordings. Time counts all runs, so each comes with its first looks.

        Until a whole recording has run, first looks say how long a run takes.
        """
        return budget.runs_left(self.asked - self.looked or (self.looked if budget.runs is None else 0), self.spent_s)

    def hindrance(self, candidate: ExperimentCandidate) -> FailureReason | None:
        """Why the candidate cannot run at all; None if it can."""
        runs = [*self.of(candidate), *self.looks_of(candidate)]
        if any(run.use in (RunUse.GOOD, RunUse.FAILED) for run in runs):
            return None
        return next((run.reason for run in runs if run.use is RunUse.CANNOT_RUN), None)


def look_at(t: Transaction, record: ExperimentRecord) -> QuestionLook:
    """Read the runs of ``record`` with the metrics that its question is about."""
    experiment = parse_experiment(record.source, f"experiment {record.name}")
    cells = t.experiments.cells(record.id, 0, None)
    candidates = candidates_of((cell.number, cell.values) for cell in cells)
    found: list[CellRun] = []
    if cells:
        found = t.experiments.cell_runs(record.id, cells[0].number, cells[-1].number, experiment.question_metrics)
    unfinished = set(t.experiments.unfinished(record.id))
    # A clip may be evaluated otherwise than the whole recording.
    of_cell = {cell: (dataset, True) for candidate in candidates for dataset, cell in candidate.looks.items()}
    of_cell |= {cell: (dataset, False) for candidate in candidates for dataset, cell in candidate.cells.items()}
    protocols: dict[tuple[str, bool], Counter[str]] = defaultdict(Counter)
    for run in found:
        if run.protocol is not None:
            protocols[of_cell[run.cell]][run.protocol] += 1
    usual = {place: counts.most_common(1)[0][0] for place, counts in protocols.items()}
    runs: dict[int, list[ObservedRun]] = defaultdict(list)
    for run in found:
        if not run.retried:
            same = run.protocol is None or run.protocol == usual[of_cell[run.cell]]
            if run.id in unfinished:
                use = RunUse.OPEN
            elif not same or run.state is RunState.CANCELLED or run.reason is FailureReason.LOST:
                use = RunUse.NOTHING
            elif run.state is RunState.FAILED:
                use = RunUse.CANNOT_RUN if run.reason is not None and run.reason.before_start else RunUse.FAILED
            else:
                use = RunUse.FAILED if run.judged is not None and run.judged.failed else RunUse.GOOD
            failure = None
            if use is RunUse.FAILED:
                failure = (run.reason or run.judged or use).value.replace("_", " ")
            runs[run.cell].append(
                ObservedRun(
                    run.id,
                    use,
                    run.state is RunState.CANCELLED,
                    run.reason,
                    dict(run.metrics),
                    disturbed=bool(run.disturbed),
                    failure=failure,
                )
            )
    looked = sum(of_cell[run.cell][1] for run in found)
    return QuestionLook(record, experiment, candidates, runs, len(found), t.experiments.spent_s(record.id), looked)
