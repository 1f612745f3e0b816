"""The search for the best of many candidates: the next runs, or the answer, from one look at the experiment."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from slamhive.analysis.adaptive_search import (
    Places,
    SearchAim,
    SearchRuns,
    SearchSpace,
    SearchState,
    first_places,
    promoted,
    search,
)
from slamhive.analysis.statistics import Numbers
from slamhive.documents.experiment import (
    AxisImportance,
    ExpectedValue,
    SearchedCandidate,
    SearchGrowth,
    SearchObjective,
    SearchStanding,
    all_failed,
)
from slamhive.domain.metrics import Direction, described
from slamhive.domain.names import plural
from slamhive.domain.parameters import Value
from slamhive.domain.question import ExperimentQuestion, QuestionAnswer, SearchSampler
from slamhive.domain.run import FailureReason
from slamhive.experiments.experiment import ALGORITHM, FAILED, LEAST_SEARCH_RUNS, ExperimentCandidate, OptimisePlan
from slamhive.services.deciding.look import STORING, ObservedRun, QuestionLook, RunUse

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
class _Objective:
    """A metric, or the share of failed runs, that is to be the best, and its scores: smaller is better.

    They are the logarithms of positive errors, else the values in units of their typical size. So a difference of
    scores is a share of the value, nearly.
    """

    key: str
    label: str
    unit: str
    logarithmic: bool = False
    sign: float = 1.0
    size: float = 1.0

    def score(self, value: float) -> float:
        return math.log(value) if self.logarithmic else self.sign * value / self.size

    def value(self, score: float) -> float:
        return math.exp(score) if self.logarithmic else self.sign * score * self.size

    def words(self, score: float) -> str:
        """Name and value: an ATE RMSE of 0.05 m."""
        if self.key == FAILED:
            return f"{self.value(score):.0%} failed"
        return f"{self.label} {self.value(score):.4g} {self.unit}".strip()


@dataclass(frozen=True, slots=True)
class _Seen:
    """Content of a search: the candidates that take part, their runs, and what follows from these.

    ``scores``: (runs, metrics), in the order of the runs, infinite for a failed one; it counts as ``worst``.
    ``looks``: the score of each place that was looked at, on a clip; ``looking`` are those whose first look goes on.
    The model sees none of them.
    """

    plan: OptimisePlan
    candidates: tuple[ExperimentCandidate, ...]
    space: SearchSpace
    axes: tuple[str, ...]
    places: Places
    pending: Places
    scores: Numbers
    worst: Numbers
    objectives: tuple[_Objective, ...]
    state: SearchState | None
    looks: Mapping[int, float] = field(default_factory=dict)
    looking: frozenset[int] = frozenset()

    @property
    def promoted(self) -> list[int]:
        """The places whose first look lets them run on the whole recording, and that have not, the best first."""
        look = self.plan.first_look
        had = {*map(int, self.places), *map(int, self.pending)}
        return [] if look is None else [place for place in promoted(self.looks, look.keep) if place not in had]

    @property
    def least(self) -> int:
        """So many runs come first: all those whose first looks are good, where there are such."""
        most = min(LEAST_SEARCH_RUNS, len(self.candidates))
        look = self.plan.first_look
        return most if look is None else max(2, min(most, len(promoted(self.looks, look.keep))))

    def fitted(self, runs: int, at_once: int = 1) -> SearchState | None:
        """The model of the first runs; None if they are too few."""
        scores = self.scores[:runs]
        if len(scores) < self.least or np.isfinite(scores).all(axis=1).sum() < 2:
            return None
        pending = len(self.pending) if runs == len(self.scores) else 0
        aim = SearchAim(self.plan.confidence, at_once, FAILED in self.plan.against, self.plan.failing)
        return search(self.space, SearchRuns(self.places[:runs], scores, self.worst, pending), aim)

    def share(self, gap: float) -> float:
        """A difference of scores as a share of the value."""
        return math.expm1(gap) if self.objectives[0].logarithmic else gap


def next_search(look: QuestionLook, plan: OptimisePlan, at_once: int) -> SearchStep:
    """Fit the model to what is known, and say what follows.

    Args:
        look: The experiment.
        plan: Its question.
        at_once: Runs that can go on at the same time; a step asks for so many.

    Raises:
        Unavailable: The sampler is one of Optuna's, which is not installed.
    """
    seen = _see(look, plan, at_once)
    answer, words, more = _outcome(look, seen, at_once)
    return SearchStep(_standing(look, seen, answer, words), more)


def _see(look: QuestionLook, plan: OptimisePlan, at_once: int) -> _Seen:
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
        and not any(run.cancelled for run in (*look.of(candidate), *look.looks_of(candidate)))
    )
    space, axes = _space(candidates)
    found: list[tuple[int, int, str, tuple[float, ...] | None]] = []
    pending: list[int] = []
    for place, candidate in enumerate(candidates):
        for dataset, cell in candidate.cells.items():
            pending += [place for run in look.runs.get(cell, ()) if run.use is RunUse.OPEN]
            for run in look.results(cell):
                values = _values(run, plan)
                if values is None:
                    found.append((run.id, place, dataset, None))
                elif len(values) == len(plan.metrics):
                    found.append((run.id, place, dataset, values))
    found.sort()
    told = np.array([row[3] or [math.nan] * len(plan.metrics) for row in found]).reshape(-1, len(plan.metrics))
    datasets = np.array([row[2] for row in found])
    scores, worst = np.empty_like(told), np.zeros(len(plan.metrics))
    objectives: list[_Objective] = []
    for column, key in enumerate(plan.metrics):
        of_metric = told[:, column]
        objective = _objective(key, of_metric)
        stated = plan.worst if key == plan.metric else None
        scores[:, column], worst[column] = _scores(objective, of_metric, datasets, stated)
        objectives.append(objective)
    if FAILED in plan.against:
        objectives.append(_Objective(FAILED, "failed runs", ""))
    places = np.array([row[1] for row in found], dtype=np.intp)
    seen = _Seen(
        plan,
        candidates,
        space,
        axes,
        places,
        np.array(pending, dtype=np.intp),
        scores,
        worst,
        tuple(objectives),
        None,
        *_first_looks(look, plan, candidates),
    )
    return replace(seen, state=seen.fitted(len(scores), at_once))


def _objective(key: str, values: Numbers) -> _Objective:
    """The comparison of the values of a metric, NaN for a failed run.

    A value that is better smaller and never 0 or less is compared as a ratio; others by their usual size.
    """
    metric, good = described(key), values[np.isfinite(values)]
    if metric.direction is Direction.LOWER and (good > 0).all():
        return _Objective(key, metric.label, metric.unit, logarithmic=True)
    sign = -1.0 if metric.direction is Direction.HIGHER else 1.0
    size = float(np.median(np.abs(good))) if len(good) else 1.0
    return _Objective(key, metric.label, metric.unit, sign=sign, size=size or 1.0)


def _first_looks(
    look: QuestionLook, plan: OptimisePlan, candidates: Sequence[ExperimentCandidate]
) -> tuple[dict[int, float], frozenset[int]]:
    """The score of each place on its clip, infinite where that failed, and the places whose first look goes on."""
    seen: list[tuple[int, str, float]] = []
    looking: set[int] = set()
    for place, candidate in enumerate(candidates):
        for dataset, cell in candidate.looks.items():
            runs = look.runs.get(cell, ())
            looking.update(place for run in runs if run.use is RunUse.OPEN)
            values = [_values(run, plan) for run in look.results(cell)]
            seen += [(place, dataset, math.nan if value is None else value[0]) for value in values if value != ()]
    of_clips = np.array([value for _, _, value in seen], dtype=float)
    # A clip can have values that no whole recording has, such as 0 dropped frames, so it is compared among clips alone.
    objective = _objective(plan.metrics[0], of_clips)
    scores, _ = _scores(objective, of_clips, np.array([dataset for _, dataset, _ in seen]), None)
    return {place: float(score) for (place, _, _), score in zip(seen, scores, strict=True)}, frozenset(looking)


def _values(run: ObservedRun, plan: OptimisePlan) -> tuple[float, ...] | None:
    """The values of the metrics that it has; None for a run that failed or broke a limit."""
    broken = any(limit.metric in run.metrics and limit.broken_by(run.metrics[limit.metric]) for limit in plan.limits)
    if run.use is not RunUse.GOOD or broken:
        return None
    return tuple(run.metrics[key] for key in plan.metrics if key in run.metrics)


def _scores(
    objective: _Objective, values: Numbers, datasets: Sequence[str] | np.ndarray, stated_worst: float | None
) -> tuple[Numbers, float]:
    """The score of each run, infinite if it failed, and that of a failed run.

    Datasets differ in how hard they are. What their means differ by is taken away, so that a candidate may have more
    runs on one than on another. What is left of a difference between candidates from dataset to dataset counts as
    noise.
    """
    scores = np.array([math.inf if math.isnan(value) else objective.score(value) for value in values], dtype=float)
    good = np.isfinite(scores)
    if not good.any():
        return scores, 0.0
    of_dataset = [good & (datasets == dataset) for dataset in sorted(set(datasets[good]))]
    mean = np.mean([scores[chosen].mean() for chosen in of_dataset])
    for chosen in of_dataset:
        scores[chosen] -= scores[chosen].mean() - mean
    if stated_worst is not None:
        return scores, objective.score(stated_worst)
    largest = objective.value(float(scores[good].max())) * objective.sign
    return scores, objective.score(objective.sign * (largest + abs(largest)))


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
        key: Callable[[Value], object] = (lambda value: value) if numbers else str
        order = sorted(known, key=key)  # type: ignore[arg-type]
        ranks = {value: rank / max(1, len(order) - 1) for rank, value in enumerate(order)}
        columns.append([math.nan if value is None else ranks[value] for value in values])
        ordered.append(numbers)
        told.append(axis)
    codes = np.array(columns).T if columns else np.zeros((len(candidates), 1))
    return SearchSpace(codes, tuple(ordered) or (True,)), tuple(told)


def _outcome(look: QuestionLook, seen: _Seen, at_once: int) -> tuple[QuestionAnswer, str, Mapping[int, int]]:
    """The answer, what is to be said, and the next runs by cell.

    Runs may be under way: others join them when half of the places are free.
    """
    plan, state = seen.plan, seen.state
    if not look.record.complete:
        return QuestionAnswer.OPEN, STORING, {}
    if not seen.candidates:
        return QuestionAnswer.UNDECIDED, "Undecided: no candidate can run.", {}
    waiting = len(seen.pending) + len(seen.looking)
    under_way: tuple[QuestionAnswer, str, Mapping[int, int]] = (
        QuestionAnswer.OPEN,
        f"{plural(waiting, 'run')} under way.",
        {},
    )
    near_enough = state is not None and seen.share(state.gap) <= plan.within
    # The best ones need runs of their own: one on a front, two without one.
    least, runs = 1 if len(seen.objectives) > 1 else 2, Counter(map(int, [*seen.places, *seen.pending]))
    unproven = [] if state is None else [place for place in state.front if runs[place] < least]
    if near_enough and not unproven and state is not None:
        return under_way if waiting else (QuestionAnswer.BEST, _sentence(look, seen, state), {})
    left = look.runs_left(plan.budget)
    room = min(at_once - waiting, left)
    if state is None:
        return _beginning(look, seen, left, at_once, under_way)
    if room < 1 or waiting > at_once // 2:
        return under_way if waiting else (QuestionAnswer.UNDECIDED, _sentence(look, seen, state), {})
    proving = unproven and (near_enough or left <= len(unproven) + at_once)
    if proving:  # the last runs are for what the answer names
        chosen, why = unproven[:room], "it seems to be the best, and has too few runs"
    elif plan.sampler is SearchSampler.MODEL:
        chosen, why = list(state.next[:room]), "each may be the best"
    else:
        chosen, why = _sampled(seen, room), f"as {plan.sampler.value} of Optuna suggests"
    looks: list[int] = []
    if plan.first_look is not None and not proving:
        # A clip may mislead: of those that the model wants although their looks are behind, one runs in each step.
        looks = [
            place for place in dict.fromkeys(chosen) if not runs[place] and not look.looks_of(seen.candidates[place])
        ]
        again = [place for place in chosen if runs[place]]
        best = seen.promoted
        settled = {*looks, *seen.looking, *best}
        behind = [place for place in chosen if not runs[place] and place not in settled]
        behind.sort(key=lambda place: seen.looks.get(place, math.inf))
        chosen = [*best, *behind[:1], *again][:room]
        why += ", or has the best of the first looks"
    counts = Counter(chosen).most_common()
    words = "; ".join(f"{seen.candidates[place].label} ({plural(count, 'run')})" for place, count in counts)
    words = f"{words}: {why}." if counts else ""
    if looks and plan.first_look is not None:
        names = "; ".join(seen.candidates[place].label for place in looks)
        words = f"{words} First looks, {plan.first_look.words} each, at {names}.".lstrip()
    if not looks and not chosen:  # all that the model wants has its first look under way
        return under_way
    more = _cells(look, seen, looks, looks=True) if looks else {}
    return QuestionAnswer.OPEN, words, more | _cells(look, seen, chosen)


_Outcome = tuple[QuestionAnswer, str, Mapping[int, int]]


def _beginning(look: QuestionLook, seen: _Seen, left: int, at_once: int, under_way: _Outcome) -> _Outcome:
    """The first looks and the first runs, before anything can be said of those that have not run.

    Of a budget of time nobody knows what fits, until the first few have ended.
    """
    plan, waiting = seen.plan, len(seen.pending) + len(seen.looking)
    few = None if plan.budget.time_s is None else max(0, at_once - waiting)
    # A clip may be too short for a metric that the whole has, so whole recordings decide what is reported.
    good = [run for candidate in seen.candidates for run in look.of(candidate) if run.use is RunUse.GOOD]
    lacking = [key for key in plan.metrics if good and not any(key in run.metrics for run in good)]
    if lacking and not waiting:
        why = f"Undecided: no run reports {' and '.join(lacking)}. Another metric can be searched for."
        return QuestionAnswer.UNDECIDED, why, {}
    order = first_places(len(seen.candidates), int(look.record.uid[:8], 16))
    if plan.first_look is not None and left > 0:
        wanted = [int(place) for place in order[: math.ceil(LEAST_SEARCH_RUNS / plan.first_look.keep)]]
        unseen = [place for place in wanted if not look.looks_of(seen.candidates[place])]
        fits = look.looks_left(plan.budget, plan.first_look.keep) if look.clips.ended else few
        unseen = unseen[:fits]
        if unseen:
            words = f"First looks, {plan.first_look.words} each, at random places."
            return QuestionAnswer.OPEN, words, _cells(look, seen, unseen, looks=True)
        if seen.looking:
            return under_way
    first = LEAST_SEARCH_RUNS if plan.first_look is None else seen.least
    missing = first - len(seen.scores) - waiting
    missing = min(max(missing, 0 if waiting else 1), left)
    if few is not None and not (look.wholes.ended or look.clips.ended):
        missing = min(missing, few)
    if missing < 1:
        return under_way if waiting else (QuestionAnswer.UNDECIDED, _nothing_good(look, seen), {})
    new = [int(place) for place in order if not look.of(seen.candidates[place])]
    chosen = list(dict.fromkeys([*seen.promoted, *new]))
    chosen = [*chosen, *map(int, order)][:missing]
    words = "The first runs, at random places." if plan.first_look is None else "The best of the first looks."
    return QuestionAnswer.OPEN, words, _cells(look, seen, chosen)


def _sampled(seen: _Seen, room: int) -> list[int]:
    from slamhive.analysis.optuna_sampling import suggested  # noqa: PLC0415 - an extra

    scores = np.where(np.isfinite(seen.scores), seen.scores, seen.worst)
    return list(suggested(seen.plan.sampler, seen.space, seen.places, scores, room, seen.pending))


def _cells(look: QuestionLook, seen: _Seen, chosen: Sequence[int], *, looks: bool = False) -> dict[int, int]:
    """The runs by cell: each candidate runs where it has the fewest runs. ``looks``: on clips."""
    more: Counter[int] = Counter()
    for turn, place in enumerate(chosen):
        candidate = seen.candidates[place]
        cells = list((candidate.looks if looks else candidate.cells).values())
        turned = [cells[(turn + step) % len(cells)] for step in range(len(cells))]
        more[min(turned, key=lambda cell: len(look.runs.get(cell, ())) + more[cell])] += 1
    return dict(more)


def _sentence(look: QuestionLook, seen: _Seen, state: SearchState) -> str:
    """Say what is known, for somebody who stops now."""
    plan, first = seen.plan, seen.objectives[0]
    share = f"{100 * seen.share(state.gap):.2g} %"
    confidence = f"at {100 * plan.confidence:.4g} % confidence"
    spent = f"After {look.asked - look.looked} runs of {look.combinations} combinations"
    if plan.first_look is not None:
        spent += f" and {plural(look.looked, 'first look')}"
    ends = {state.front[0]: None} | {
        min(state.front, key=lambda place: float(state.scores[place, column])): None
        for column in range(1, len(seen.objectives))
    }
    told = [f"{seen.candidates[place].label} ({', '.join(_told(seen, state, place))})" for place in ends]
    if len(seen.objectives) == 1:
        label, score = seen.candidates[state.front[0]].label, float(state.scores[state.front[0], 0])
        value = f"{first.value(score):.4g} {first.unit}".strip()
        return f"{spent}, {label} is within {share} of the best {confidence}, with a typical {first.label} of {value}."
    if len(state.front) == 1:
        return f"{spent}, {told[0]} is the best in everything within {share}, {confidence}."
    others = " and ".join(objective.label for objective in seen.objectives[1:])
    return (
        f"{spent}, {len(state.front)} combinations are the best trade-offs of {first.label} against {others}: no other "
        f"is better in all of them by more than {share}, {confidence}. At the ends: {'; '.join(told)}."
    )


def _told(seen: _Seen, state: SearchState, place: int) -> list[str]:
    """The values of a candidate, in words."""
    return [objective.words(float(state.scores[place, column])) for column, objective in enumerate(seen.objectives)]


def _nothing_good(look: QuestionLook, seen: _Seen) -> str:
    """Why there is no best one, with the nearest to a limit that no run kept, or only one."""
    plan = seen.plan
    for limit in plan.limits:
        values = [
            (run.metrics[limit.metric], candidate.label)
            for candidate in seen.candidates
            for run in look.of(candidate)
            if run.use is RunUse.GOOD and limit.metric in run.metrics
        ]
        broken = [entry for entry in values if limit.broken_by(entry[0])]
        if broken and len(values) - len(broken) < 2:
            nearest, label = min(broken) if limit.at_most else max(broken)
            sign, unit = "<=" if limit.at_most else ">=", described(limit.metric).unit
            kept = f"only 1 of {plural(len(values), 'run')}" if len(values) > len(broken) else "no run"
            return (
                f"Undecided: {kept} kept {limit.metric} {sign} {limit.value:.4g} {unit}; the nearest"
                f"{' of the others' if len(values) > len(broken) else ''} is {label} with {nearest:.4g}."
            )
    made = plural(look.asked - look.looked, "run")
    if plan.budget.time_s is not None and len(seen.scores) < seen.least:
        room = f"the budget of {plan.budget.words} had room for {made}"
        return f"Undecided: {room}, and {seen.least} are needed to say anything."
    return f"Undecided: fewer than two of {made} were good."


def _standing(look: QuestionLook, seen: _Seen, answer: QuestionAnswer, words: str) -> SearchStanding:
    plan, state, first = seen.plan, seen.state, seen.objectives[0]
    is_open = answer is QuestionAnswer.OPEN
    limits = [
        f"{limit.metric} {'<=' if limit.at_most else '>='} {limit.value:.6g} {described(limit.metric).unit}".strip()
        for limit in plan.limits
    ]
    if plan.failing is not None:
        limits.append(f"failed <= {plan.failing:.4g}")
    importance = [
        AxisImportance(axis=axis, objective=objective.key, share=share)
        for objective, shares in zip(seen.objectives, () if state is None else state.importance, strict=False)
        for axis, share in sorted(zip(seen.axes, shares, strict=False), key=lambda entry: -entry[1])
    ]

    # The state after 24, 48, 96 runs and so on, and now: computed from the runs, so that a kill loses nothing.
    steps: list[int] = []
    runs = LEAST_SEARCH_RUNS
    while runs < len(seen.scores):
        steps.append(runs)
        runs *= 2
    growth = []
    for runs in [*steps, len(seen.scores)]:
        then = state if runs == len(seen.scores) else seen.fitted(runs)
        if then is not None:
            front = tuple(
                {
                    objective.key: objective.value(float(then.scores[place, column]))
                    for column, objective in enumerate(seen.objectives)
                }
                for place in then.front
            )
            growth.append(SearchGrowth(runs=runs, gap=seen.share(then.gap), front=front))

    return SearchStanding(
        experiment=look.record.name,
        question=ExperimentQuestion.OPTIMISE,
        answer=answer,
        words=("Nothing is known yet." if state is None else _sentence(look, seen, state)) if is_open else words,
        metric=first.key,
        label=first.label,
        unit=first.unit,
        against=tuple(
            SearchObjective(metric=other.key, label=other.label, unit=other.unit) for other in seen.objectives[1:]
        ),
        limits=tuple(limits),
        within=plan.within,
        confidence=plan.confidence,
        gap=None if state is None else seen.share(state.gap),
        expected_gain=None if state is None else seen.share(state.expected_gap),
        budget=plan.budget.words,
        runs=look.asked - look.looked,
        first_looks=look.looked,
        combinations=look.combinations,
        datasets=look.datasets,
        candidates=tuple(_leading(look, seen)),
        importance=tuple(importance),
        growth=tuple(growth),
        next=words if is_open else "",
        notes=tuple(_notes(look, seen)),
    )


def _leading(look: QuestionLook, seen: _Seen) -> list[SearchedCandidate]:
    """The candidates with the best expected scores, the best first; with several objectives, the best trade-offs."""
    state = seen.state
    if state is None:
        return []
    shown = np.argsort(state.scores[:, 0])[:_SHOWN] if len(seen.objectives) == 1 else state.front
    found = []
    for place in shown:
        candidate = seen.candidates[place]
        runs = [run for cell in candidate.cells.values() for run in look.results(cell)]
        failed = sum(_values(run, seen.plan) is None for run in runs)
        expected: list[ExpectedValue] = []
        for column, objective in enumerate(seen.objectives):
            if objective.key != FAILED and all_failed(len(runs), failed) is not None:
                expected.append(ExpectedValue(expected=None, low=None, high=None))
                continue
            score, spread = float(state.scores[place, column]), _TWO_SIDED * float(state.spread[place, column])
            ends = sorted(objective.value(score + side * spread) for side in (-1, 1))
            if objective.key == FAILED:
                ends = [max(0.0, ends[0]), min(1.0, ends[1])]
            expected.append(ExpectedValue(expected=objective.value(score), low=ends[0], high=ends[1]))
        found.append(
            SearchedCandidate(
                label=candidate.label,
                values=candidate.values,
                cells=dict(candidate.cells),
                runs=len(runs),
                failed=failed,
                **expected[0].model_dump(),
                failing=float(state.failing[place]),
                against={
                    objective.key: value for objective, value in zip(seen.objectives[1:], expected[1:], strict=True)
                },
                on_front=int(place) in state.front,
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
