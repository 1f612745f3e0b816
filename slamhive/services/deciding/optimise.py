"""The search for the best of many candidates: the next runs, or the answer, from one look at the experiment."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from slamhive.analysis.adaptive_search import SearchSpace, SearchState, first_places, search
from slamhive.analysis.statistics import Numbers
from slamhive.documents.question import AxisImportance, SearchedCandidate, SearchStanding
from slamhive.domain.metrics import Direction, Metric, described
from slamhive.domain.names import plural
from slamhive.domain.parameters import Value
from slamhive.domain.question import ExperimentQuestion, QuestionAnswer
from slamhive.domain.run import FailureReason
from slamhive.experiments.candidates import ALGORITHM, LEAST_SEARCH_RUNS, ExperimentCandidate
from slamhive.experiments.experiment import OptimisePlan
from slamhive.services.deciding.look import ObservedRun, QuestionLook, RunUse

_SHOWN = 12
_TWO_SIDED = 1.96
"""Standard deviations of a normal distribution to both sides that hold 95 %."""


@dataclass(frozen=True, slots=True)
class SearchStep:
    """State of the experiment, and the number of further runs for each cell."""

    decision: SearchStanding
    more: Mapping[int, int] = field(default_factory=dict)

    @property
    def ended(self) -> bool:
        """It has an answer, or can have none."""
        return self.decision.answer is not QuestionAnswer.OPEN


@dataclass(frozen=True, slots=True)
class _Scale:
    """Scores from values of the metric and back: logarithms of positive errors, else the values, smaller is better."""

    logarithmic: bool
    sign: float

    def score(self, value: float) -> float:
        return math.log(value) if self.logarithmic else self.sign * value

    def value(self, score: float) -> float:
        return math.exp(score) if self.logarithmic else self.sign * score

    def share(self, gap: float, score: float) -> float:
        """A difference of scores as a share of the value at ``score``."""
        return math.expm1(gap) if self.logarithmic else gap / max(abs(score), 1e-12)


@dataclass(frozen=True, slots=True)
class _Seen:
    """Content of a search: the candidates that take part, their runs, and what follows from these."""

    plan: OptimisePlan
    metric: Metric
    candidates: tuple[ExperimentCandidate, ...]
    space: SearchSpace
    axes: tuple[str, ...]
    places: tuple[int, ...]
    scores: Numbers
    scale: _Scale
    state: SearchState | None


def next_search(look: QuestionLook, plan: OptimisePlan, at_once: int) -> SearchStep:
    """Fit the model to what is known, and say what follows.

    Args:
        look: The experiment.
        plan: Its question.
        at_once: Runs that can go on at the same time; a step asks for so many.
    """
    seen = _see(look, plan, max(4, at_once))
    answer, words, more = _outcome(look, seen, max(4, at_once))
    return SearchStep(_standing(look, seen, answer, words), more)


def _see(look: QuestionLook, plan: OptimisePlan, at_once: int) -> _Seen:
    metric = described(plan.metric)
    broken = {
        candidate.values[ALGORITHM]
        for candidate in look.candidates
        if look.hindrance(candidate) is FailureReason.IMAGE_MISSING
    }
    candidates = tuple(
        candidate
        for candidate in look.candidates
        if candidate.values[ALGORITHM] not in broken
        and look.hindrance(candidate) is None
        and not any(run.cancelled for run in look.of(candidate))
    )
    space, axes = _space(candidates)
    places: list[int] = []
    found: list[tuple[str, float | None]] = []
    for place, candidate in enumerate(candidates):
        for dataset, cell in candidate.cells.items():
            for run in look.results(cell):
                kept, value = _value(run, plan)
                if value is not None or not kept:
                    places.append(place)
                    found.append((dataset, value if kept else None))
    good = [value for _, value in found if value is not None]
    logarithmic = metric.direction is Direction.LOWER and all(value > 0 for value in good)
    scale = _Scale(logarithmic, -1.0 if metric.direction is Direction.HIGHER else 1.0)
    scores, worst = _scores(found, scale, plan.worst)
    state = None
    if len(scores) >= min(LEAST_SEARCH_RUNS, len(candidates)) and len(good) > 1:
        state = search(space, np.array(places), scores, worst, plan.confidence, at_once)
    return _Seen(plan, metric, candidates, space, axes, tuple(places), scores, scale, state)


def _value(run: ObservedRun, plan: OptimisePlan) -> tuple[bool, float | None]:
    """Tell if the run keeps all limits, and its value; None without one."""
    kept = run.use is RunUse.GOOD and not any(
        limit.metric in run.metrics and limit.broken_by(run.metrics[limit.metric]) for limit in plan.limits
    )
    return kept, run.metrics.get(plan.metric)


def _scores(
    found: Sequence[tuple[str, float | None]], scale: _Scale, stated_worst: float | None
) -> tuple[Numbers, float]:
    """The score of each run, infinite if it failed, and that of a failed run.

    Datasets differ in how hard they are. What their means differ by is taken away, so that a candidate may have more
    runs on one than on another. What is left of a difference between candidates from dataset to dataset counts as
    noise.
    """
    scores = np.array([math.inf if value is None else scale.score(value) for _, value in found], dtype=float)
    datasets = np.array([dataset for dataset, _ in found])
    good = np.isfinite(scores)
    if not good.any():
        return scores, 0.0
    mean = np.mean([scores[good & (datasets == dataset)].mean() for dataset in set(datasets[good])])
    for dataset in set(datasets[good]):
        of_dataset = good & (datasets == dataset)
        scores[of_dataset] -= scores[of_dataset].mean() - mean
    if stated_worst is not None:
        return scores, scale.score(stated_worst)
    largest = scale.value(float(scores[good].max())) * scale.sign
    return scores, scale.score(scale.sign * (largest + abs(largest)))


def _space(candidates: Sequence[ExperimentCandidate]) -> tuple[SearchSpace, tuple[str, ...]]:
    """The candidates as points. Numbers have an order, and steps between their ranks are alike."""
    axes = tuple(dict.fromkeys(axis for candidate in candidates for axis in candidate.values))
    columns: list[list[float]] = []
    ordered: list[bool] = []
    told: list[str] = []
    for axis in axes:
        values = [candidate.values.get(axis) for candidate in candidates]
        known = {value for value in values if value is not None}
        if len(known) < 2 and None not in values:
            continue
        numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in known)
        ranks = _ranks(known, numbers)
        columns.append([math.nan if value is None else ranks[value] for value in values])
        ordered.append(numbers)
        told.append(axis)
    codes = np.array(columns).T if columns else np.zeros((len(candidates), 1))
    return SearchSpace(codes, tuple(ordered) or (True,)), tuple(told)


def _ranks(known: set[Value], numbers: bool) -> dict[Value, float]:
    key: Callable[[Value], object] = (lambda value: value) if numbers else str
    order = sorted(known, key=key)  # type: ignore[arg-type]
    return {value: rank / max(1, len(order) - 1) for rank, value in enumerate(order)}


def _outcome(look: QuestionLook, seen: _Seen, at_once: int) -> tuple[QuestionAnswer, str, Mapping[int, int]]:
    """The answer, what is to be said, and the next runs by cell."""
    plan, state = seen.plan, seen.state
    if not seen.candidates:
        return QuestionAnswer.UNDECIDED, "Undecided: no candidate can run.", {}
    waiting = sum(run.use is RunUse.OPEN for runs in look.runs.values() for run in runs)
    if waiting:
        return QuestionAnswer.OPEN, f"{plural(waiting, 'run')} under way.", {}
    if state is not None:
        repeated = sum(place == state.best for place in seen.places)
        if _share(seen, state.gap) <= plan.within and repeated > 1:
            return QuestionAnswer.BEST, _sentence(look, seen, state), {}
    room = min(at_once, plan.budget.runs_left(look.asked, look.spent_s))
    if room < 1:
        words = _nothing_good(look, seen) if state is None else _sentence(look, seen, state)
        return QuestionAnswer.UNDECIDED, words, {}
    if state is None:
        order = first_places(len(seen.candidates), int(look.record.uid[:8], 16))
        new = [int(place) for place in order if not look.of(seen.candidates[place])]
        missing = max(1, LEAST_SEARCH_RUNS - len(seen.scores))
        chosen = [*new, *map(int, order)][: min(missing, plan.budget.runs_left(look.asked, look.spent_s))]
        return QuestionAnswer.OPEN, "The first runs, at random places.", _cells(look, seen, chosen)
    chosen = list(state.next[:room])
    counts = Counter(chosen).most_common()
    words = "; ".join(f"{seen.candidates[place].label} ({plural(count, 'run')})" for place, count in counts)
    return QuestionAnswer.OPEN, f"{words}: each may be the best.", _cells(look, seen, chosen)


def _cells(look: QuestionLook, seen: _Seen, chosen: Sequence[int]) -> dict[int, int]:
    """The runs by cell: each candidate runs where it has the fewest runs."""
    more: Counter[int] = Counter()
    for turn, place in enumerate(chosen):
        cells = list(seen.candidates[place].cells.values())
        turned = [cells[(turn + step) % len(cells)] for step in range(len(cells))]
        more[min(turned, key=lambda cell: len(look.runs.get(cell, ())) + more[cell])] += 1
    return dict(more)


def _share(seen: _Seen, gap: float) -> float:
    assert seen.state is not None
    return seen.scale.share(gap, float(seen.state.scores[seen.state.best]))


def _sentence(look: QuestionLook, seen: _Seen, state: SearchState) -> str:
    plan = seen.plan
    label = seen.candidates[state.best].label
    value = f"{seen.scale.value(float(state.scores[state.best])):.4g} {seen.metric.unit}".strip()
    near = f"within {100 * _share(seen, state.gap):.2g} % of the best at {100 * plan.confidence:.4g} % confidence"
    spent = f"After {look.asked} runs of {_combinations(look)}"
    return f"{spent}, {label} is {near}, with a typical {seen.metric.label} of {value}."


def _nothing_good(look: QuestionLook, seen: _Seen) -> str:
    """Why there is no best one, with the nearest to a limit that no run kept."""
    plan = seen.plan
    good = [run for runs in look.runs.values() for run in runs if run.use is RunUse.GOOD]
    for limit in plan.limits:
        values = [
            (run.metrics[limit.metric], candidate.label)
            for candidate in seen.candidates
            for run in look.of(candidate)
            if run.use is RunUse.GOOD and limit.metric in run.metrics
        ]
        if values and all(limit.broken_by(value) for value, _ in values):
            nearest, label = min(values) if limit.at_most else max(values)
            sign, unit = "<=" if limit.at_most else ">=", described(limit.metric).unit
            return (
                f"Undecided: no run kept {limit.metric} {sign} {limit.value:.4g} {unit}; the nearest is {label} with "
                f"{nearest:.4g}."
            )
    if good and not any(plan.metric in run.metrics for run in good):
        return f"Undecided: no run reports {plan.metric}. Another metric can be searched for."
    return f"Undecided: fewer than two of {plural(look.asked, 'run')} were good."


def _combinations(look: QuestionLook) -> int:
    return len(look.candidates) * len(look.datasets)


def _standing(look: QuestionLook, seen: _Seen, answer: QuestionAnswer, words: str) -> SearchStanding:
    plan, state = seen.plan, seen.state
    is_open = answer is QuestionAnswer.OPEN
    importance: list[AxisImportance] = []
    if state is not None:
        importance = [
            AxisImportance(axis=axis, share=share) for axis, share in zip(seen.axes, state.importance, strict=False)
        ]
    return SearchStanding(
        experiment=look.record.name,
        question=ExperimentQuestion.OPTIMISE,
        answer=answer,
        words=("Nothing is known yet." if state is None else _sentence(look, seen, state)) if is_open else words,
        metric=seen.metric.key,
        label=seen.metric.label,
        unit=seen.metric.unit,
        limits=tuple(
            f"{limit.metric} {'<=' if limit.at_most else '>='} {limit.value:.6g} {described(limit.metric).unit}".strip()
            for limit in plan.limits
        ),
        within=plan.within,
        confidence=plan.confidence,
        gap=None if state is None else _share(seen, state.gap),
        expected_gain=None if state is None else _share(seen, state.expected_gap),
        budget=plan.budget.words,
        runs=look.asked,
        combinations=_combinations(look),
        datasets=look.datasets,
        candidates=tuple(_leading(look, seen)),
        importance=tuple(sorted(importance, key=lambda entry: -entry.share)),
        next=words if is_open else "",
        notes=tuple(_notes(look, seen)),
    )


def _leading(look: QuestionLook, seen: _Seen) -> list[SearchedCandidate]:
    """The candidates with the best expected scores, the best first."""
    state = seen.state
    if state is None:
        return []
    found = []
    for place in np.argsort(state.scores)[:_SHOWN]:
        candidate = seen.candidates[place]
        runs = [run for cell in candidate.cells.values() for run in look.results(cell)]
        score, spread = float(state.scores[place]), _TWO_SIDED * float(state.spread[place])
        ends = sorted(seen.scale.value(score + side * spread) for side in (-1, 1))
        found.append(
            SearchedCandidate(
                label=candidate.label,
                values=candidate.values,
                cells=dict(candidate.cells),
                runs=len(runs),
                failed=sum(not _value(run, seen.plan)[0] for run in runs),
                expected=seen.scale.value(score),
                low=ends[0],
                high=ends[1],
                failing=float(state.failing[place]),
            )
        )
    return found


def _notes(look: QuestionLook, seen: _Seen) -> list[str]:
    """Say what was left out, and why."""
    notes = []
    left_out = [candidate for candidate in look.candidates if candidate not in seen.candidates]
    broken = sorted(
        {
            str(candidate.values[ALGORITHM])
            for candidate in left_out
            if look.hindrance(candidate) is FailureReason.IMAGE_MISSING
        }
    )
    if broken:
        notes.append(f"{', '.join(broken)} cannot be built, and takes no part.")
    cancelled = [candidate.label for candidate in left_out if any(run.cancelled for run in look.of(candidate))]
    if cancelled:
        notes.append(f"Cancelled by hand, and takes no part: {'; '.join(cancelled)}.")
    others = [
        candidate.label
        for candidate in left_out
        if look.hindrance(candidate) not in (None, FailureReason.IMAGE_MISSING)
    ]
    if others:
        notes.append(f"Cannot run, and takes no part: {'; '.join(others)}.")
    return notes
