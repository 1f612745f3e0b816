"""Runs that a search for a bad commit or a short clip looks at: found, counted and made."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from slamhive.analysis.statistics import Numbers
from slamhive.documents.submission import Submission
from slamhive.domain.gate import FAILURES
from slamhive.domain.metrics import Direction, Metric, described
from slamhive.domain.run import RunState
from slamhive.domain.verdict import Outcome, outcome_words
from slamhive.experiments.file import compared_metric
from slamhive.store import RunRecord, Store

if TYPE_CHECKING:
    from slamhive.services.configurations import Configurations
    from slamhive.services.runs import RunService
    from slamhive.services.searches import Searches

Tell = Callable[[str], None]
"""Takes one line about what is going on."""
Work = Callable[[Sequence[int]], None]
"""Runs the runs with these numbers to their end, evaluations included."""

MOST_RUNS = 50
"""What is still undecided after so many runs on each dataset is skipped."""
FIRST_RUNS = 2
"""So many are looked at first: a program that does not even start needs no more."""


def searched_metric(key: str) -> Metric:
    """A metric with a better direction, or the share of failed runs; raises NotFound or InvalidInput."""
    if key == FAILURES:
        return Metric(FAILURES, "Failed runs", "", Direction.LOWER, "Share of failed runs.", needs_protocol=False)
    return compared_metric(key)


@dataclass(frozen=True, slots=True)
class TrialRuns:
    """The runs of one submission that a search looks at, in order; ``metric`` is what it compares."""

    records: tuple[RunRecord, ...]
    metric: str

    @property
    def open(self) -> list[int]:
        """The numbers of those that have not ended."""
        return [run.id for run in self.records if not Outcome.of(run).ended]

    @property
    def ended(self) -> list[RunRecord]:
        """Those that say something: good ones with a value, and failed ones. The others were cancelled or lost."""
        return [run for run in self.records if Outcome.of(run) is Outcome.FAILED or self.value(run) is not None]

    @property
    def failed(self) -> list[RunRecord]:
        """Those that failed."""
        return [run for run in self.records if Outcome.of(run) is Outcome.FAILED]

    def value(self, run: RunRecord) -> float | None:
        """The value of a good run; None without one."""
        if Outcome.of(run) is not Outcome.GOOD:
            return None
        return 0.0 if self.metric == FAILURES else (run.metrics or {}).get(self.metric)

    @property
    def values(self) -> Numbers:
        """The values of the good runs."""
        found = (self.value(run) for run in self.records)
        return np.array([value for value in found if value is not None], dtype=float)

    @property
    def scores(self) -> Numbers:
        """A score for each run that says something: smaller is better, infinite for a failed one."""
        failed_as = 1.0 if self.metric == FAILURES else math.inf
        sign = -1.0 if described(self.metric).direction is Direction.HIGHER else 1.0
        found = [(run, self.value(run)) for run in self.ended]
        return np.array([failed_as if value is None else sign * value for _, value in found], dtype=float)

    @property
    def hindrance(self) -> str | None:
        """Why the submission cannot be tried at all, in words; None if it can."""
        for run in self.records:
            if run.reason is not None and run.reason.before_start:
                return f"run {run.id} {outcome_words(run)}"
        silent = [run for run in self.records if Outcome.of(run) in (Outcome.GOOD, Outcome.UNJUDGED)]
        if len(silent) >= FIRST_RUNS and not self.ended:
            return f"run {silent[0].id} has no value of {self.metric}"
        return None


class Trials:
    """Finds and makes the runs of submissions.

    Args:
        store: The runs.
        searches: Finds them.
        configurations: Knows which configuration a submission is.
        runs: Submits more.
        metric: What is compared.
        since: Runs from before play no part; None for all.
    """

    def __init__(
        self,
        store: Store,
        searches: Searches,
        configurations: Configurations,
        runs: RunService,
        metric: str,
        since: datetime | None = None,
    ) -> None:
        self._store = store
        self._searches = searches
        self._configurations = configurations
        self._runs = runs
        self._metric = metric
        self._since = since

    def check(self, submission: Submission) -> None:
        """Raise NotFound or InvalidInput if the submission cannot run."""
        self._configurations.check(submission)

    def of(self, submission: Submission) -> TrialRuns:
        """The runs that there are. Raises NotFound or InvalidInput if the submission cannot be used."""
        known = self._configurations.same_as(submission)
        run_ids = [] if known is None else self._searches.find(f"configuration = {known.id}")
        records = self._store.read(lambda t: t.runs.get_many(run_ids, with_metrics=True))
        return TrialRuns(
            tuple(run for run in records if self._since is None or run.created_at >= self._since), self._metric
        )

    def ask(self, submission: Submission, wanted: int) -> list[int]:
        """Queue runs until ``wanted`` say something, as far as it is known; the numbers of those that are open."""
        found = self.of(submission)
        lacking = wanted - len(found.ended) - len(found.open)
        if lacking <= 0:
            return found.open
        asked = replace(submission, repeat=lacking, seed=len(found.records), evaluate=True)
        return [*found.open, *(run.id for run in self._runs.submit(asked))]


@dataclass(frozen=True, slots=True)
class Trial:
    """A commit or a clip that was tried: its runs on each dataset, or why there are none."""

    runs: tuple[TrialRuns, ...] = ()
    problem: str = ""
    version: str | None = None

    @property
    def scores(self) -> list[Numbers]:
        """The scores of its runs on each dataset."""
        return [entry.scores for entry in self.runs]

    @property
    def fewest(self) -> int:
        """Number of runs that say something, on the dataset with the fewest."""
        return min((len(entry.ended) for entry in self.runs), default=0)

    @property
    def crashes(self) -> bool:
        """No run so far ended well: the program of the commit does not work."""
        ended = [run for entry in self.runs for run in entry.ended]
        return len(ended) >= FIRST_RUNS and all(run.state is RunState.FAILED for run in ended)

    @property
    def silent(self) -> int:
        """Number of runs that have ended and say nothing."""
        return sum(len(entry.records) - len(entry.ended) - len(entry.open) for entry in self.runs)

    @property
    def spent_s(self) -> float:
        """Sum of the durations of its runs."""
        runs = [run for entry in self.runs for run in entry.records]
        return sum((run.ended_at - run.started_at).total_seconds() for run in runs if run.ended_at and run.started_at)

    @property
    def mean(self) -> float | None:
        """The mean of the good runs over the datasets; None without one."""
        means = [float(entry.values.mean()) for entry in self.runs if len(entry.values)]
        return float(np.mean(means)) if means else None

    @property
    def std(self) -> float | None:
        """The standard deviation of a good run within its dataset; None for fewer than two."""
        groups = [entry.values for entry in self.runs if len(entry.values)]
        degrees = sum(len(values) - 1 for values in groups)
        squares = sum(float(((values - values.mean()) ** 2).sum()) for values in groups)
        return math.sqrt(squares / degrees) if degrees > 0 else None

    @property
    def asked(self) -> int:
        """Number of all runs, whatever they say."""
        return sum(len(entry.records) for entry in self.runs)

    @property
    def failure(self) -> str:
        """Its first failed run, in words; empty if none failed."""
        failed = [run for entry in self.runs for run in entry.failed]
        return f"run {failed[0].id} {outcome_words(failed[0])}" if failed else ""
