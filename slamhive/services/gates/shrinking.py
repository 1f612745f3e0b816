"""The shortest part of a recording, with the fewest sensors, that still shows what is wrong with a run.

Each clip is a variant of the dataset, and each run an ordinary run. Whoever looks next comes to the same step, because
it follows from the runs in the database.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamhive.analysis.bisection import Clip, Scores, next_runs, search_clips, step_error, step_verdict
from slamhive.analysis.statistics import Numbers
from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.base.files import size_bytes
from slamhive.documents.gate import ShrinkAnswer, ShrinkStep
from slamhive.documents.submission import Submission
from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.configuration import CLIP, Variant, VariantStep, clipped_span_s
from slamhive.domain.dataset import Dataset
from slamhive.domain.gate import BisectOutcome, Margin, TrialStanding
from slamhive.domain.metrics import Direction, Metric
from slamhive.domain.names import mean_and_std, plural
from slamhive.domain.packages import version_label
from slamhive.domain.question import RunBudget
from slamhive.domain.verdict import Failure, Outcome, failure_of, failure_words
from slamhive.recordings.reader import open_bag
from slamhive.recordings.staging import Progress, new_dataset_folder
from slamhive.recordings.variants.build import build_variant, plan_variant
from slamhive.services.datasets import check_writable
from slamhive.services.gates.trials import FIRST_RUNS, MOST_RUNS, Tell, Trial, TrialRuns, Trials, Work
from slamhive.store import RunRecord

if TYPE_CHECKING:
    from slamhive.base.settings import Settings
    from slamhive.services.configurations import Configurations
    from slamhive.services.datasets import Catalogue
    from slamhive.services.gates.service import Gates
    from slamhive.services.runs import RunService

_PARTS = 64
"""The ends of a clip are found to this part of the recording."""
_LEAST_STEP_S = 0.5
_LATER = timedelta(microseconds=1)
_NONE = Margin(0.0, relative=False)


@dataclass(frozen=True, slots=True)
class ShrinkRequest:
    """A request to shorten the recording of a run.

    Attributes:
        run_id: The run that shows a fault.
        metric: What is compared, unless the run failed.
        difference: How much worse than the other one is allowed.
        against: A run that is good, or ``ALGORITHM@VERSION``; None for the fault of the run by itself.
        worse_than: The value of the metric that a good run does not exceed; None without one.
        share: A failure shows in at least this share of the runs.
        error: The largest chance that the clip does not show the fault.
        most: A clip that is undecided after so many runs counts as not showing it.
        budget: Of all runs.
        step_s: How exactly the ends of the clip are found; None for 1/64 of the recording, and at least 0.5 s.
        target: The folder for the clip.
    """

    run_id: int
    metric: Metric
    difference: Margin
    target: Path
    against: str | None = None
    worse_than: float | None = None
    share: float = 0.5
    error: float = 0.05
    most: int = MOST_RUNS
    budget: RunBudget | None = None
    step_s: float | None = None


@dataclass(frozen=True, slots=True)
class FailureRuns(TrialRuns):
    """Runs that are asked whether they fail as another one did: 1 for each that does, 0 for the others."""

    failure: Failure | None = None

    def value(self, run: RunRecord) -> float | None:
        """0 for a run that ended well, however large its error is."""
        return 0.0 if Outcome.of(run) in (Outcome.GOOD, Outcome.UNJUDGED) else None

    @property
    def scores(self) -> Numbers:
        """1 for each run that failed for the same reason."""
        return np.array([float(failure_of(run) == self.failure) for run in self.ended], dtype=float)


class Shrinkings:
    """Finds short clips.

    Args:
        settings: Mode.
        catalogue: Datasets and algorithms.
        configurations: Knows what runs executed.
        runs: The run that shows the fault.
        gates: Find and make runs.
    """

    def __init__(
        self,
        settings: Settings,
        catalogue: Catalogue,
        configurations: Configurations,
        runs: RunService,
        gates: Gates,
    ) -> None:
        self._settings = settings
        self._catalogue = catalogue
        self._configurations = configurations
        self._runs = runs
        self._gates = gates

    def find(
        self, request: ShrinkRequest, work: Work, tell: Tell, progress: Callable[[], AbstractContextManager[Progress]]
    ) -> ShrinkAnswer:
        """Search for the shortest clip, and write it to a folder.

        Raises:
            NotFound: There is no such run, version or dataset.
            InvalidInput: The run shows no fault, or not reliably.
            Conflict: The run has not ended, or the folder exists.
        """
        check_writable(self._settings)
        if request.target.exists():
            raise Conflict(f"{request.target} exists already", "choose another folder with --to")
        run = self._runs.get(request.run_id)
        fault = self._fault(request, run)
        dataset = self._catalogue.dataset(run.dataset)
        with open_bag(dataset.bag_path) as reader:
            recorded = reader.start_time * 1e-9, reader.end_time * 1e-9
        names = [sensor.name for sensor in dataset.sensors]
        span = clipped_span_s(names, run.variant)
        begin_s, end_s = recorded if span is None else (max(recorded[0], span[0]), min(recorded[1], span[1]))
        search = ShrinkSearch(request, fault, dataset, (begin_s, end_s), tell)
        clip, steps, outcome = search.run(work)
        variant = fault.variant(clip, dataset)
        kept = sorted({name for entry in fault.submissions(variant) for name in self._needed(entry, dataset)})
        if outcome is BisectOutcome.FOUND:
            source_bytes = size_bytes(dataset.bag_path)
            plan = plan_variant(dataset, variant)
            needed_bytes = source_bytes if plan is None else min(plan.needed_bytes, source_bytes)
            with new_dataset_folder(request.target, needed_bytes) as aside, progress() as show:
                build_variant(dataset, variant, aside, show, kept)
        return search.answer(run, clip, steps, outcome, kept)

    def _needed(self, submission: Submission, dataset: Dataset) -> Iterator[str]:
        algorithm = self._catalogue.algorithm(submission.algorithm)
        for sensor in algorithm.assign(dataset, submission.sensors).values():
            yield sensor.name

    def _fault(self, request: ShrinkRequest, run: RunRecord) -> Fault:
        """The fault of the run."""
        if not run.state.ended or run.executor == IMPORTED:
            problem = "was imported" if run.executor == IMPORTED else f"is {run.state}"
            raise Conflict(f"run {run.id} {problem}", "name a run that was executed here and has ended")
        outcome = Outcome.of(run)
        if outcome in (Outcome.CANCELLED, Outcome.LOST, Outcome.UNJUDGED):
            raise InvalidInput(f"run {run.id} is {outcome.label}: that says nothing", "name another run")
        own = self._submission(run)
        trials = self._gates.trials(request.metric.key, run.created_at + _LATER)
        if request.against is not None:
            # The version or run that it is worse than, on the same recording.
            text = request.against
            if text.isascii() and text.isdigit():
                named = self._runs.get(int(text))
                if named.dataset != run.dataset:
                    problem = f"run {named.id} is of {named.dataset}, run {run.id} of {run.dataset}"
                    raise InvalidInput(problem, "name another")
                other = replace(self._submission(named), variant=own.variant, executor=own.executor)
            else:
                algorithm = self._catalogue.algorithm(text)
                keys = {parameter.key for parameter in algorithm.parameters}
                parameters = {key: value for key, value in own.parameters.items() if key in keys}
                other = replace(own, algorithm=text, parameters=parameters)
            if other == own:
                raise InvalidInput(f"--against {text} is what run {run.id} ran", "name another version or run")
            return Fault(request, trials, own, f"is worse than {text}", other=other)
        if request.worse_than is not None:
            unit = request.metric.unit
            words = f"has {request.metric.label} above {request.worse_than:.6g} {unit}".rstrip()
            return Fault(request, trials, own, words)
        if outcome is not Outcome.FAILED:
            raise InvalidInput(
                f"run {run.id} is good: nothing says what is wrong with it",
                "give --against a good run or ALGORITHM@VERSION, or --worse-than NUMBER",
            )
        failure = failure_of(run)
        assert failure is not None
        return Fault(request, trials, own, f"failed ({failure_words(failure)})", failure=failure)

    def _submission(self, run: RunRecord) -> Submission:
        """The submission that repeats the run: with the very version that ran, if it was kept."""
        submission, _ = self._configurations.submission(run.configuration_id)
        if run.version is not None and run.version.number is not None:
            label = version_label(run.algorithm, run.version.number)
            try:
                self._catalogue.algorithm(label)
            except NotFound:
                label = submission.algorithm
            submission = replace(submission, algorithm=label)
        return replace(submission, executor=run.executor, **run.options)


@dataclass(frozen=True, slots=True)
class Fault:
    """The fault of a run, and the test whether a clip shows it.

    Attributes:
        request: The question.
        trials: Find and make runs.
        own: How the run is repeated.
        words: The fault in words.
        other: How the good one is run; None if the fault needs no other.
        failure: The reason for which a run fails; None if values are compared.
    """

    request: ShrinkRequest
    trials: Trials
    own: Submission
    words: str
    other: Submission | None = None
    failure: Failure | None = None

    def variant(self, span_s: tuple[float, float] | None, dataset: Dataset) -> Variant:
        """The steps of the run, and the clip between two times of the recording."""
        if span_s is None:
            return self.own.variant
        names = tuple(sensor.name for sensor in dataset.sensors)
        kept = tuple(step for step in self.own.variant if step.kind != CLIP or set(step.sensors) != set(names))
        return (*kept, VariantStep(CLIP, names, {"begin_s": span_s[0], "end_s": span_s[1]}))

    def submissions(self, variant: Variant) -> list[Submission]:
        """The candidates that run on a clip: the faulty one, and the good one if there is one."""
        return [replace(entry, variant=variant) for entry in (self.own, self.other) if entry is not None]

    def trial(self, variant: Variant) -> Trial:
        """The runs on a clip."""
        found = []
        for submission in self.submissions(variant):
            self.trials.check(submission)
            runs = self.trials.of(submission)
            found.append(FailureRuns(runs.records, runs.metric, self.failure) if self.failure is not None else runs)
        return Trial(tuple(found))

    def scores(self, trial: Trial) -> tuple[Scores, Scores, Margin]:
        """The value of a good run, that of the faulty one, and the difference that is allowed."""
        own = trial.runs[0].scores
        if self.other is not None:
            return [trial.runs[1].scores], [own], self.request.difference
        limit = self.request.share if self.failure is not None else self._limit
        return [np.full(len(own), limit)], [own], _NONE

    @property
    def _limit(self) -> float:
        """The value that a good run does not exceed, as a score: smaller is better."""
        assert self.request.worse_than is not None
        sign = -1.0 if self.request.metric.direction is Direction.HIGHER else 1.0
        return sign * self.request.worse_than


class ShrinkSearch:
    """One search. It keeps nothing but what it has just read.

    Args:
        request: The question.
        fault: What is wrong.
        dataset: Its recording is shortened.
        span_s: The times between which the run saw it, in s since 1970.
        tell: Takes a line for each step.
    """

    def __init__(
        self, request: ShrinkRequest, fault: Fault, dataset: Dataset, span_s: tuple[float, float], tell: Tell
    ) -> None:
        self._request = request
        self._fault = fault
        self._dataset = dataset
        self._begin_s, self._end_s = span_s
        self._tell = tell
        self._told: set[Clip] = set()
        duration_s = self._end_s - self._begin_s
        self._step_s = request.step_s or max(_LEAST_STEP_S, duration_s / _PARTS)
        self._expected = 2 * math.ceil(math.log2(max(2.0, duration_s / self._step_s))) + 1
        self._begin()

    def _begin(self) -> None:
        self._settled: dict[Clip, ShrinkStep] = {}
        self._decisions = 0
        self._runs = 0
        self._spent_s = 0.0
        self._need: tuple[Variant, int] | None = None

    def run(self, work: Work) -> tuple[tuple[float, float], tuple[ShrinkStep, ...], BisectOutcome]:
        """Take step after step; the clip in s since 1970, what was tried, and whether it is the shortest.

        Raises InvalidInput if the whole recording does not show the fault.
        """
        whole: Clip = (0.0, self._end_s - self._begin_s)
        while True:
            self._begin()
            best, asks = whole, False
            standing = self._standing(whole)
            if standing is TrialStanding.GOOD:
                step = self._settled[whole]
                raise InvalidInput(
                    f"run {self._request.run_id} {self._fault.words}, but {plural(len(step.runs), 'run')} like it say "
                    f"that the recording {step.words}",
                    "a lower --share finds what seldom shows" if self._fault.failure is not None else None,
                )
            if standing is TrialStanding.BAD:
                state = search_clips(whole[1], self._step_s, self._standing)
                best, asks = state.best, state.ask is not None
            found = tuple(self._settled.values())
            if self._need is None:
                is_known = standing is TrialStanding.BAD and not asks
                return self._absolute(best), found, BisectOutcome.FOUND if is_known else BisectOutcome.UNDECIDED
            variant, wanted = self._need
            submissions = self._fault.submissions(variant)
            known = [self._fault.trials.of(entry) for entry in submissions]
            lacking = sum(max(0, wanted - len(entry.ended) - len(entry.open)) for entry in known)
            budget = self._request.budget
            if budget is not None and lacking > budget.runs_left(self._runs, self._spent_s):
                return self._absolute(best), found, BisectOutcome.UNDECIDED
            work([run_id for entry in submissions for run_id in self._fault.trials.ask(entry, wanted)])

    def _absolute(self, clip: Clip) -> tuple[float, float]:
        """The times of a clip in s since 1970, to 10 ms: texts of steps hold no more digits."""
        begin_s = self._begin_s if clip[0] == 0 else self._begin_s + clip[0]
        return math.floor(begin_s * 100) / 100, math.ceil((self._begin_s + clip[1]) * 100) / 100

    def _standing(self, clip: Clip) -> TrialStanding | None:
        if clip not in self._settled:
            whole = clip == (0.0, self._end_s - self._begin_s)
            variant = self._fault.variant(None if whole else self._absolute(clip), self._dataset)
            trial = self._fault.trial(variant)
            self._runs += trial.asked
            self._spent_s += trial.spent_s
            found = self._settle(clip, variant, trial)
            if found is None:
                return None
            self._settled[clip] = found
            if clip not in self._told:
                self._told.add(clip)
                self._tell(f"{clip[0]:.1f} s to {clip[1]:.1f} s: {found.words}")
        return self._settled[clip].standing

    def _settle(self, clip: Clip, variant: Variant, trial: Trial) -> ShrinkStep | None:
        """Decide about a clip; None if more runs are needed."""
        error = step_error(self._request.error, self._decisions, self._expected)
        reference, values, difference = self._fault.scores(trial)
        verdict = step_verdict(reference, values, difference, error)
        standing, reason = verdict.standing, ""
        done = trial.fewest
        if standing is None:
            hindrance = next((entry.hindrance for entry in trial.runs if entry.hindrance is not None), None)
            if hindrance is not None:
                standing, reason = TrialStanding.SKIPPED, hindrance
            elif done >= self._request.most or trial.silent > self._request.most:
                standing, reason = TrialStanding.SKIPPED, f"undecided after {plural(trial.asked, 'run')}"
            else:
                wanted = next_runs(max(done, FIRST_RUNS), 1, error)
                self._need = (variant, min(self._request.most, wanted))
                return None
        self._decisions += 1
        own = trial.runs[0]
        return ShrinkStep(
            begin_s=clip[0],
            end_s=clip[1],
            standing=standing,
            words=self._words(standing, reason, trial),
            runs=tuple(run.id for entry in trial.runs for run in entry.records),
            failed=len(own.failed),
            mean=float(own.values.mean()) if len(own.values) else None,
            std=float(own.values.std(ddof=1)) if len(own.values) > 1 else None,
            e_value=verdict.e_value,
        )

    def _words(self, standing: TrialStanding, reason: str, trial: Trial) -> str:
        """The finding on a clip, with the values."""
        shown = {
            TrialStanding.BAD: "shows it",
            TrialStanding.GOOD: "does not show it",
            TrialStanding.SKIPPED: f"counts as not showing it, {reason}",
        }[standing]
        if self._fault.failure is not None:
            same = int(trial.runs[0].scores.sum())
            return f"{shown}: {same} of {plural(len(trial.runs[0].ended), 'run')} {self._fault.words}"
        values = []
        for entry in trial.runs:
            good = entry.values
            std = float(good.std(ddof=1)) if len(good) > 1 else None
            text = mean_and_std(float(good.mean()), std) if len(good) else "no good run"
            values.append(f"{text}, {len(entry.failed)} failed" if entry.failed else text)
        unit = self._request.metric.unit
        return f"{shown}: {self._request.metric.label} {' against '.join(values)} {unit}".rstrip()

    def answer(
        self,
        run: RunRecord,
        clip: tuple[float, float],
        steps: Sequence[ShrinkStep],
        outcome: BisectOutcome,
        kept: Sequence[str],
    ) -> ShrinkAnswer:
        """The answer as a document."""
        recording_s = self._end_s - self._begin_s
        begin_s, end_s = max(0.0, clip[0] - self._begin_s), min(recording_s, clip[1] - self._begin_s)
        left_out = [sensor.name for sensor in self._dataset.sensors if sensor.name not in kept]
        written = outcome is BisectOutcome.FOUND
        part = f"{end_s - begin_s:.1f} s of {recording_s:.1f} s, from {begin_s:.1f} s on"
        words = f"Run {run.id} {self._fault.words}: {part}, with {', '.join(kept)}, still show it."
        if not written:
            words = f"Undecided after {plural(self._runs, 'run')}. The shortest part so far is {part}."
        notes = [f"Left out, since nothing needs them: {', '.join(left_out)}."] if left_out and written else []
        return ShrinkAnswer(
            answer=outcome,
            words=words,
            run=run.id,
            dataset=run.dataset,
            fault=self._fault.words,
            begin_s=begin_s,
            end_s=end_s,
            recording_s=recording_s,
            variant=self._fault.variant(clip, self._dataset),
            sensors=tuple(kept),
            left_out=tuple(left_out),
            folder=str(self._request.target) if written else None,
            size_bytes=size_bytes(self._request.target) if written else None,
            error=self._request.error,
            decisions=self._decisions,
            runs=self._runs,
            steps=tuple(steps),
            notes=tuple(notes),
        )
