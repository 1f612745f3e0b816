"""Races between candidates: which is best, with as few runs as the answer needs.

Runs come in rounds. A round adds one run of each remaining candidate on each dataset, so that datasets count alike.
After each round every pair of candidates is compared, and whoever is clearly worse than another leaves. The race ends
when one candidate is left, or when those that are left differ by no more than what matters.

Whoever looks after every round needs an interval that holds at all looks together. Student's interval does not. Here it
comes from a test martingale, the Bayes factor of the t statistic for a normal prior of the effect size (M. Gönen et
al., The American Statistician 59, 2005, equation 6). It exceeds 1 / error with a chance of at most ``error``, however
often it is looked at and whenever somebody stops (M. F. Pérez-Ortiz et al., Annals of Statistics 52, 2024; H. Wang and
A. Ramdas, Electronic Journal of Statistics 19, 2025). So no number of looks has to be planned, and a budget can be
raised later. Neither SciPy nor statsmodels has such a test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import permutations

import numpy as np

from slamhive.analysis.statistics import Numbers
from slamhive.domain.gate import Margin

PRIOR_VARIANCE = 1.0
"""Of the effect size, in standard deviations of a run. It decides where the test is sharpest, not how often it errs."""
LEAST_ROUNDS = 2
"""With one run of each there is no spread."""


class RaceAnswer(StrEnum):
    """Answer of the runs so far."""

    BEST = "best"
    SAME = "same"
    OPEN = "open"


@dataclass(frozen=True, slots=True)
class RaceRule:
    """The question of a race.

    Attributes:
        difference: The largest difference that does not matter. A share is one of the smaller mean of the two.
        error: The largest chance that the answer is false.
        worst: What a failed run counts as, where smaller is better. None takes :func:`counted`'s rule.
    """

    difference: Margin
    error: float = 0.05
    worst: float | None = None


@dataclass(frozen=True, slots=True)
class PairDifference:
    """The mean of one candidate less that of another, over the datasets.

    ``half_width`` is that of the two-sided interval, ``one_sided`` the distance of the upper bound. Both are infinite
    while the runs are too few. ``matters``: the largest difference that does not matter.
    """

    first: int
    second: int
    value: float
    half_width: float
    one_sided: float
    matters: float

    @property
    def worse(self) -> bool:
        """The first is certainly worse."""
        return self.value > self.half_width

    @property
    def close(self) -> bool:
        """The first is certainly not worse by more than what matters."""
        return self.value + self.one_sided <= self.matters


@dataclass(frozen=True, slots=True)
class RaceLane:
    """One candidate: how many rounds it ran, its mean score, and by whom it was beaten after which round."""

    rounds: int
    mean: float | None
    beaten_by: int | None = None


@dataclass(frozen=True, slots=True)
class RaceState:
    """The state of a race.

    Attributes:
        answer: Of the rounds that are complete.
        left: The candidates that remain, the best mean first.
        rounds: Complete rounds of those.
        lanes: All candidates, in order.
        pairs: The comparisons between those that remain, in both directions.
    """

    answer: RaceAnswer
    left: tuple[int, ...]
    rounds: int
    lanes: tuple[RaceLane, ...]
    pairs: tuple[PairDifference, ...]


def race(rule: RaceRule, scores: Sequence[Sequence[Numbers]]) -> RaceState:
    """Replay the rounds from the first, so that the same runs give the same state whoever looks and whenever.

    With k candidates each comparison may err with ``error / (k - 1)``. Only the k - 1 comparisons with the one that is
    truly best can make the answer false (C. E. Bonferroni). For each of them, one error is possible at a time. If the
    difference matters, it is a bound that is too low, which has one side. If it does not, it is the exclusion of the
    best.

    Args:
        rule: What is asked.
        scores: For each candidate, for each dataset, the scores of its runs in their order; smaller is better, infinite
            for a failed run. All candidates have the same datasets.
    """
    candidates = len(scores)
    level = rule.error / max(1, candidates - 1)
    left = list(range(candidates))
    lanes = [RaceLane(0, None) for _ in scores]
    pairs: list[PairDifference] = []
    answer = RaceAnswer.BEST if candidates == 1 else RaceAnswer.OPEN
    rounds = 0
    while answer is RaceAnswer.OPEN and all(len(values) > rounds for lane in left for values in scores[lane]):
        rounds += 1
        seen = counted([[values[:rounds] for values in scores[lane]] for lane in left], rule.worst)
        for lane, values in zip(left, seen, strict=True):
            lanes[lane] = RaceLane(rounds, float(values.mean()))
        if rounds < LEAST_ROUNDS:
            continue
        pairs = [
            _compared(rule, level, (left[first], left[second]), (seen[first], seen[second]))
            for first, second in permutations(range(len(left)), 2)
        ]
        for pair in sorted(pairs, key=lambda pair: lanes[pair.second].mean or 0.0, reverse=True):
            if pair.worse:
                lanes[pair.first] = replace(lanes[pair.first], beaten_by=pair.second)
        left = [lane for lane in left if lanes[lane].beaten_by is None]
        pairs = [pair for pair in pairs if pair.first in left and pair.second in left]
        if len(left) == 1:
            answer = RaceAnswer.BEST
        elif all(pair.close for pair in pairs):
            answer = RaceAnswer.SAME
    left.sort(key=lambda lane: (lanes[lane].mean is None, lanes[lane].mean, lane))
    return RaceState(answer, tuple(left), rounds, tuple(lanes), tuple(pairs))


def counted(scores: Sequence[Sequence[Numbers]], worst: float | None) -> list[Numbers]:
    """The scores with a number for failed runs, a (datasets, runs) array for each candidate.

    A failed run counts as ``worst``. Without it, it counts as twice the worst good score on its dataset: twice the
    largest error, or 0 where more is better and scores are negative. On a dataset without a good run, all count as 0.

    Args:
        scores: For each candidate, for each dataset, equally many scores; infinite for a failed run.
        worst: What a failed run counts as.
    """
    tables = [np.array(of_candidate, dtype=float) for of_candidate in scores]
    for dataset in range(len(tables[0])):
        rows = [table[dataset] for table in tables]
        good = np.concatenate([row[np.isfinite(row)] for row in rows])
        largest = float(good.max()) if len(good) else 0.0
        failed_as = largest + abs(largest) if worst is None else worst
        for row in rows:
            row[~np.isfinite(row)] = failed_as
    return tables


def half_width_factor(degrees: int, size: float, error: float) -> float:
    """The half width of an interval of a mean difference that holds at all looks, in standard errors.

    It solves "Bayes factor = 1 / error" for t. With n the effective size, g the prior variance and v the degrees of
    freedom, the factor is ``(1 + n g)^-1/2 [(1 + t²/v) / (1 + t²/(v (1 + n g)))]^((v + 1)/2)``.

    Args:
        degrees: Of freedom of the pooled variance.
        size: Effective size: the variance of a run over that of the difference.
        error: Chance that the interval misses at any look.

    Returns:
        Infinity while the runs are too few for any interval.
    """
    if degrees < 1:
        return math.inf
    growth = 1 + size * PRIOR_VARIANCE
    ratio = (math.sqrt(growth) / error) ** (2 / (degrees + 1))
    return math.inf if ratio >= growth else math.sqrt(degrees * (ratio - 1) / (1 - ratio / growth))


def _compared(rule: RaceRule, level: float, places: tuple[int, int], values: tuple[Numbers, Numbers]) -> PairDifference:
    """Compare two candidates, each with a (datasets, runs) array.

    The variance is pooled over candidates and datasets. Their sizes are equal, so its mean is right even where the
    variances differ.
    """
    means = [float(table.mean()) for table in values]
    standard_error, degrees, size = _standard_error(*values)
    # Of the two directions in which the martingale at twice the level may err, each has half of the chance.
    factors = (half_width_factor(degrees, size, sides * level) for sides in (1, 2))
    both, one = (factor if math.isinf(factor) else factor * standard_error for factor in factors)
    matters = rule.difference.value * (min(map(abs, means)) if rule.difference.relative else 1.0)
    return PairDifference(*places, means[0] - means[1], both, one, matters)


def _standard_error(first: Numbers, second: Numbers) -> tuple[float, int, float]:
    """Standard error of the difference of the means, its degrees of freedom, and the effective size."""
    datasets, runs = first.shape
    squares = sum(float(((table - table.mean(axis=1, keepdims=True)) ** 2).sum()) for table in (first, second))
    degrees, size = 2 * datasets * (runs - 1), datasets * runs / 2
    return math.sqrt(squares / degrees / size), degrees, size


def bayes_factor(first: Numbers, second: Numbers) -> float:
    """The evidence that two candidates differ, of two (datasets, runs) arrays with at least two runs.

    It is the factor of :func:`half_width_factor`. If they do not differ, it ever exceeds 1 / p with a chance of at most
    p. Values that do not vary give the largest factor of their number, or the smallest if the means are equal.
    """
    standard_error, degrees, size = _standard_error(first, second)
    difference = abs(float(first.mean()) - float(second.mean()))
    growth = 1 + size * PRIOR_VARIANCE
    if standard_error > 0:
        square = (difference / standard_error) ** 2 / degrees
        ratio = (1 + square) / (1 + square / growth)
    else:
        ratio = growth if difference > 0 else 1.0
    return float(ratio ** ((degrees + 1) / 2) / math.sqrt(growth))
