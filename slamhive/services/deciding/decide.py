"""The race between candidates: the next runs, or the answer, from one look at the experiment."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from slamhive.analysis.racing import LEAST_ROUNDS, RaceAnswer, RaceRule, RaceState, race
from slamhive.analysis.statistics import Numbers
from slamhive.documents.experiment import Decision, DecisionCandidate, all_failed
from slamhive.domain.metrics import Direction, Metric, described
from slamhive.domain.names import plural
from slamhive.domain.question import CandidateStanding, ExperimentQuestion, QuestionAnswer
from slamhive.experiments.experiment import DecidePlan, ExperimentCandidate
from slamhive.services.deciding.look import STORING, QuestionLook, RunUse


@dataclass(frozen=True, slots=True)
class DecisionStep:
    """State of the experiment, and the number of further runs for each cell."""

    decision: Decision
    more: Mapping[int, int] = field(default_factory=dict)

    @property
    def ended(self) -> bool:
        """It has an answer, or can have none."""
        return self.decision.answer is not QuestionAnswer.OPEN


@dataclass(frozen=True, slots=True)
class _Entered:
    """The candidates that take part, and the race between them."""

    plan: DecidePlan
    metric: Metric
    sign: float
    racing: tuple[ExperimentCandidate, ...]
    state: RaceState


def next_decision(look: QuestionLook, plan: DecidePlan, at_once: int) -> DecisionStep:
    """Race the candidates on what is known, and say what follows.

    Args:
        look: The experiment.
        plan: Its question.
        at_once: Runs that can go on at the same time; a step asks for at least so many, as far as they help.
    """
    metric = described(plan.metric)
    sign = -1.0 if metric.direction is Direction.HIGHER else 1.0
    racing = tuple(candidate for candidate in look.candidates if look.hindrance(candidate) is None)
    if not look.record.complete:
        return DecisionStep(_decision(look, plan, None, QuestionAnswer.OPEN, STORING))
    if not racing:
        reasons = ", ".join(sorted({str(look.hindrance(candidate)).replace("_", " ") for candidate in look.candidates}))
        words = f"Undecided: no candidate can run: {reasons}."
        return DecisionStep(_decision(look, plan, None, QuestionAnswer.UNDECIDED, words))
    scores = [[_scores(look, cell, plan.metric, sign) for cell in entry.cells.values()] for entry in racing]
    rule = RaceRule(plan.difference, plan.error, None if plan.worst is None else sign * plan.worst)
    entered = _Entered(plan, metric, sign, racing, race(rule, scores))
    answer, words, more = _outcome(look, entered, at_once)
    return DecisionStep(_decision(look, plan, entered, answer, words), more)


def _outcome(look: QuestionLook, entered: _Entered, at_once: int) -> tuple[QuestionAnswer, str, Mapping[int, int]]:
    """The answer, what is to be said, and the next runs by cell."""
    state, racing = entered.state, entered.racing
    if len(racing) == 1 < len(look.candidates):
        words = f"Undecided: {racing[0].label} is the only candidate that can run."
        return QuestionAnswer.UNDECIDED, words, {}
    if state.answer is not RaceAnswer.OPEN:
        answer = QuestionAnswer.BEST if state.answer is RaceAnswer.BEST else QuestionAnswer.SAME
        return answer, _words(look, entered), {}
    left = [racing[place] for place in state.left]
    waiting = sum(run.use is RunUse.OPEN for candidate in left for run in look.of(candidate))
    if waiting:
        return QuestionAnswer.OPEN, f"{plural(waiting, 'run')} under way.", {}
    results = [run for candidate in racing for cell in candidate.cells.values() for run in look.results(cell)]
    good = [run for run in results if run.use is RunUse.GOOD]
    if results and not good:
        reasons = sorted({str(run.reason or "bad result").replace("_", " ") for run in results})
        words = f"Undecided: all {plural(len(results), 'run')} failed: {', '.join(reasons)}."
        return QuestionAnswer.UNDECIDED, words, {}
    if results and not any(entered.plan.metric in run.metrics for run in good):
        words = f"Undecided: no run reports {entered.metric.key}. Another metric can be compared."
        return QuestionAnswer.UNDECIDED, words, {}
    more = _more(look, entered, left, at_once)
    if not more:
        return QuestionAnswer.UNDECIDED, _words(look, entered), {}
    labels = " and ".join(candidate.label for candidate in left)
    where = plural(len(look.datasets), "dataset")
    return QuestionAnswer.OPEN, f"More runs of {labels} on {where}, because nothing separates them yet.", more


def _scores(look: QuestionLook, cell: int, metric: str, sign: float) -> Numbers:
    """The scores of a cell, (n,): smaller is better, infinite for a failed run.

    Good runs without the metric are left out.
    """
    values = []
    for run in look.results(cell):
        if run.use is RunUse.FAILED:
            values.append(math.inf)
        elif metric in run.metrics:
            values.append(sign * run.metrics[metric])
    return np.array(values, dtype=float)


def _more(look: QuestionLook, entered: _Entered, left: Sequence[ExperimentCandidate], at_once: int) -> dict[int, int]:
    """The runs that the next rounds lack; none if the budget has no room for them."""
    budget = entered.plan.budget
    per_round = len(left) * len(look.datasets)
    rounds = max(LEAST_ROUNDS, entered.state.rounds + max(1, math.ceil(at_once / per_round)))
    while rounds > entered.state.rounds:
        lacking = {
            cell: rounds - len(_scores(look, cell, entered.plan.metric, entered.sign))
            for candidate in left
            for cell in candidate.cells.values()
        }
        more = {cell: count for cell, count in lacking.items() if count > 0}
        if sum(more.values()) <= look.runs_left(budget):
            return more
        rounds -= 1
    return {}


def _words(look: QuestionLook, entered: _Entered) -> str:
    """The answer in one sentence."""
    plan, state = entered.plan, entered.state
    labels = [entered.racing[place].label for place in state.left]
    spent = (
        f"after {look.asked} of at most {plan.budget.words}"
        if plan.budget.runs
        else f"after {plural(look.asked, 'run')}"
    )
    chance = f"The chance that this is false is {100 * plan.error:.4g} % at most."
    if state.answer is RaceAnswer.BEST:
        mean = state.lanes[state.left[0]].mean
        value = "" if mean is None else f" with {_amount(entered, entered.sign * mean)} on average"
        return f"{labels[0]} is best in {entered.metric.label}{value}, {spent}. {chance}"
    if state.answer is RaceAnswer.SAME:
        margin = plan.difference.words(entered.metric.unit)
        return (
            f"{' and '.join(labels)}: no difference larger than {margin} in {entered.metric.label}, {spent}. {chance}"
        )
    open_ones = " or ".join(labels)
    return f"Undecided after the budget of {plan.budget.words}: {open_ones} may be best in {entered.metric.label}."


def _amount(entered: _Entered, value: float) -> str:
    return f"{value:.4g} {entered.metric.unit}".strip()


def _decision(
    look: QuestionLook, plan: DecidePlan, entered: _Entered | None, answer: QuestionAnswer, words: str
) -> Decision:
    metric = described(plan.metric)
    is_open = answer is QuestionAnswer.OPEN

    # Those that are left with the best mean first, then the beaten ones, the last beaten first.
    places = {} if entered is None else {candidate.label: place for place, candidate in enumerate(entered.racing)}
    order = list(look.candidates)
    if entered is not None:
        state = entered.state
        beaten = sorted(
            (place for place in range(len(entered.racing)) if place not in state.left),
            key=lambda place: (-state.lanes[place].rounds, state.lanes[place].mean),
        )
        inside = [entered.racing[place] for place in (*state.left, *beaten)]
        order = [*inside, *(candidate for candidate in look.candidates if candidate.label not in places)]
    shown = []
    for candidate in order:
        runs = [run for run in look.of(candidate) if run.use in (RunUse.GOOD, RunUse.FAILED)]
        row = DecisionCandidate(
            label=candidate.label,
            values=candidate.values,
            cells=dict(candidate.cells),
            standing=CandidateStanding.ASIDE,
            runs=len(runs),
            failed=sum(run.use is RunUse.FAILED for run in runs),
            mean=None,
        )
        place = places.get(candidate.label)
        if entered is not None and place is not None:
            state, lane = entered.state, entered.state.lanes[place]
            standing = CandidateStanding.BEATEN if lane.beaten_by is not None else CandidateStanding.LEFT
            if answer is QuestionAnswer.BEST and place in state.left:
                standing = CandidateStanding.BEST
            pair = next((pair for pair in state.pairs if (pair.first, pair.second) == (place, state.left[0])), None)
            known = pair is not None and math.isfinite(pair.half_width)
            # The mean of failed runs alone is what a failure counts as, which nobody measured.
            measured = all_failed(row.runs, row.failed) is None
            known = known and measured
            row = row.model_copy(
                update={
                    "standing": standing,
                    "rounds": lane.rounds,
                    "mean": None if lane.mean is None or not measured else entered.sign * lane.mean,
                    "beaten_by": None if lane.beaten_by is None else entered.racing[lane.beaten_by].label,
                    "difference": entered.sign * pair.value if pair is not None and known else None,
                    "difference_within": pair.half_width if pair is not None and known else None,
                }
            )
        shown.append(row)
    ranked = sorted(shown, key=lambda entry: list(CandidateStanding).index(entry.standing))

    return Decision(
        experiment=look.record.name,
        question=ExperimentQuestion.DECIDE,
        answer=answer,
        words="Not decided yet." if is_open else words,
        metric=metric.key,
        label=metric.label,
        unit=metric.unit,
        difference=plan.difference.words(metric.unit),
        error=plan.error,
        budget=plan.budget.words,
        runs=look.asked,
        datasets=look.datasets,
        candidates=tuple(ranked),
        next=words if is_open else "",
        notes=tuple(_notes(look)),
    )


def _notes(look: QuestionLook) -> list[str]:
    """Say what was left out, and why."""
    notes = []
    for candidate in look.candidates:
        reason = look.hindrance(candidate)
        if reason is not None:
            notes.append(f"{candidate.label} is set aside, because it cannot run: {reason.value.replace('_', ' ')}.")
        failures = Counter(run.failure for run in look.of(candidate) if run.failure is not None)
        if failures:
            why = ", ".join(f"{word} {count}" for word, count in failures.most_common())
            notes.append(
                f"{candidate.label}: {failures.total()} of {plural(len(look.of(candidate)), 'run')} failed: {why}."
            )
    runs = [run for of_cell in look.runs.values() for run in of_cell]
    disturbed = sum(run.disturbed for run in runs)
    if disturbed:
        notes.append(
            f"{disturbed} of {plural(len(runs), 'run')} ran on a disturbed machine, where frames may be lost. "
            "Stop other programs, or play in sequence (playback: {mode: sequential})."
        )
    cancelled = sum(run.cancelled for run in runs)
    lost = sum(run.use is RunUse.NOTHING and not run.cancelled for run in runs)
    if cancelled:
        notes.append(f"{plural(cancelled, 'run')} cancelled by hand; others took their place.")
    if lost:
        notes.append(f"{plural(lost, 'run')} lost, or evaluated under another protocol; others took their place.")
    return notes
