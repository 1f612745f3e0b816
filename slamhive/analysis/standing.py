"""Ranks of competitors over the same sequences; those that no test separates share one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from slamhive.analysis.statistics import Interval, Numbers, bootstrap_mean

LEAST_FOR_WILCOXON = 6
"""With fewer pairs the signed-rank test has no p value below 0.05."""


@dataclass(frozen=True, slots=True)
class Standing:
    """One competitor.

    Attributes:
        place: Its position in the input.
        rank: 1 is best. No test separates competitors who share one from the first of them.
        score: Mean over the sequences.
        interval: Bootstrap interval of the score; None for a single sequence.
    """

    place: int
    rank: int
    score: float
    interval: Interval | None


def standings(points: Numbers, weights: Numbers, *, higher_wins: bool, significance: float) -> list[Standing]:
    """The competitors, the best first.

    Each is compared with the first of the rank before it, not with its neighbour. Otherwise a chain of small
    differences would let the first and the last share a rank.

    Args:
        points: (sequences, competitors), finite.
        weights: (sequences,), positive.
        higher_wins: Whether more points are better.
        significance: Level of each test.
    """
    scores = weights @ points / weights.sum()
    order = np.argsort(-scores if higher_wins else scores, kind="stable")
    found: list[Standing] = []
    first = int(order[0]) if len(order) else 0
    rank = 1
    for position, place in enumerate(map(int, order), start=1):
        if separated(points[:, first], points[:, place], significance):
            first, rank = place, position
        found.append(Standing(place, rank, float(scores[place]), _interval(points[:, place], weights)))
    return found


def separated(first: Numbers, second: Numbers, significance: float) -> bool:
    """Whether a paired test over sequences separates two competitors.

    Wilcoxon's signed-rank test, or Student's paired t test below :data:`LEAST_FOR_WILCOXON` sequences. A bootstrap of
    so few differences would be wrong far more often than it states: of three, all have one sign by chance in a quarter
    of the cases. A single sequence separates nobody.

    Args:
        first: (sequences,) finite.
        second: (sequences,) finite.
        significance: Level of the test.
    """
    differences = first - second
    if len(differences) < 2 or not np.any(differences):
        return False
    if len(differences) >= LEAST_FOR_WILCOXON:
        return bool(scipy.stats.wilcoxon(differences).pvalue < significance)
    spread = float(differences.std(ddof=1)) / math.sqrt(len(differences))
    limit = float(scipy.special.stdtrit(len(differences) - 1, 1 - significance / 2))
    return bool(abs(differences.mean()) > limit * spread)


def _interval(values: Numbers, weights: Numbers) -> Interval | None:
    return bootstrap_mean(values, weights=weights) if len(values) > 1 else None
