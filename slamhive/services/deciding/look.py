"""One look at an experiment that chooses its runs, from which everything follows."""

from __future__ import annotations

import hashlib
import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from slamhive.domain.question import MOST_RUNS, RunBudget
from slamhive.domain.run import FailureReason, RunState
from slamhive.experiments.experiment import Experiment, ExperimentCandidate, candidates_of
from slamhive.experiments.file import parse_experiment
from slamhive.store import Transaction
from slamhive.store.records import CellRun, ExperimentRecord

STORING = "Its combinations are not stored completely: starting the same file again completes them."
"""What comes next in an experiment whose start was interrupted."""


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
class SpentTime:
    """Time that runs took: ``ended`` of them ``spent_s`` together, and ``waiting`` have not ended."""

    ended: int = 0
    spent_s: float = 0.0
    waiting: int = 0

    @property
    def mean_s(self) -> float | None:
        """Time that one run takes; None before the first has ended."""
        return max(self.spent_s / self.ended, 1e-3) if self.ended else None


@dataclass(frozen=True, slots=True)
class QuestionLook:
    """One moment of an experiment.

    ``runs``: by cell, in the order in which they were asked for, without those that another replaced. ``asked`` counts
    them all. ``looked`` of them are first looks at a clip. ``wholes`` and ``clips`` say how long both kinds took. A
    whole recording is ``times_clip`` times as long as a clip, on average.
    """

    record: ExperimentRecord
    experiment: Experiment
    candidates: tuple[ExperimentCandidate, ...]
    runs: Mapping[int, Sequence[ObservedRun]]
    asked: int
    looked: int = 0
    wholes: SpentTime = SpentTime()
    clips: SpentTime = SpentTime()
    times_clip: float = 1.0

    @property
    def datasets(self) -> tuple[str, ...]:
        """The datasets, in the order of the file; none while the combinations are being stored."""
        return tuple(self.candidates[0].cells) if self.candidates else ()

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
        known = self.record.uid, self.record.complete, self.experiment.content_hash, self.asked
        told = repr((*known, self.wholes, self.clips, runs))
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
        """Number of further runs on whole recordings that the budget has room for.

        Of a budget of time, each takes as long as those that ended, and a first look comes with it. Until a whole
        recording has run, first looks say how long that takes. Before any run has ended, nothing is known.
        """
        if budget.time_s is None:
            # What cannot run has cost nothing.
            aside = [candidate for candidate in self.candidates if self.hindrance(candidate) is not None]
            unstarted = sum(run.use is RunUse.CANNOT_RUN for candidate in aside for run in self.of(candidate))
            return budget.runs_left(self.asked - self.looked - unstarted, 0.0)
        whole_s = self._whole_s
        if whole_s is None:
            return MOST_RUNS
        return max(0, math.floor(self._left_s(budget.time_s) / (whole_s + (self.clips.mean_s or 0.0))))

    def looks_left(self, budget: RunBudget, keep: float) -> int | None:
        """Number of further first looks that a budget of time has room for, with the runs that follow the best of them.

        Args:
            budget: Of the experiment. keep: The share of first looks that a run on the whole recording follows.

        Returns:
            None where the budget does not count first looks, or before one has ended.
        """
        if budget.time_s is None or self.clips.mean_s is None or (whole_s := self._whole_s) is None:
            return None
        # Those that were made still have to be followed by the share of them that is kept.
        owed_s = max(0.0, keep * self.looked - (self.asked - self.looked)) * whole_s
        return max(0, math.floor((self._left_s(budget.time_s) - owed_s) / (self.clips.mean_s + keep * whole_s)))

    @property
    def _whole_s(self) -> float | None:
        if self.wholes.mean_s is not None or self.clips.mean_s is None:
            return self.wholes.mean_s
        return self.times_clip * self.clips.mean_s

    def _left_s(self, time_s: float) -> float:
        """The rest of a budget of time when the runs that wait have ended."""
        waiting_s = self.wholes.waiting * (self._whole_s or 0.0) + self.clips.waiting * (self.clips.mean_s or 0.0)
        return time_s - self.wholes.spent_s - self.clips.spent_s - waiting_s

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
    durations_s = t.experiments.durations_s(record.id)

    def spent(*, is_clip: bool) -> SpentTime:
        of_kind = [run for run in found if of_cell[run.cell][1] is is_clip]
        took_s = [durations_s[run.id] for run in of_kind if run.id in durations_s]
        waiting = sum(run.id in unfinished and run.id not in durations_s for run in of_kind)
        return SpentTime(len(took_s), sum(took_s), waiting)

    times_clip = 1.0
    if experiment.optimise is not None and experiment.optimise.first_look is not None and candidates:
        wholes_s = [dataset.duration_s for dataset in t.catalogue.datasets() if dataset.name in candidates[0].cells]
        times_clip = sum(wholes_s) / max(1, len(wholes_s)) / experiment.optimise.first_look.seconds
    looked = sum(of_cell[run.cell][1] for run in found)
    return QuestionLook(
        record,
        experiment,
        candidates,
        runs,
        len(found),
        looked,
        wholes=spent(is_clip=False),
        clips=spent(is_clip=True),
        times_clip=times_clip,
    )
