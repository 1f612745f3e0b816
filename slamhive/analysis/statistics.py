"""Summaries, intervals and rank tests. Arrays in, numbers out; a value that cannot be computed is None, never 0."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy  # loads scipy.stats when it is first used: a second, which most plots do not need
from numpy.typing import NDArray

from slamhive.errors import InvalidInput

Numbers = NDArray[np.float64]

RESAMPLES = 2_000
CONFIDENCE = 0.95
MOST_REPEATS = 1_000_000
_MOST_ENUMERATED = 13
"""Of so many differences, some of them tied or 0, SciPy's test of signed ranks looks at each combination of signs."""
_NUMBERS_AT_ONCE = 1_000_000
"""Resampled values that are held in memory together."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A confidence interval; both ends belong to it."""

    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Summary:
    """Statistics of a group of values. ``std`` (divisor n - 1) and ``interval`` of the mean need two values."""

    count: int
    mean: float
    median: float
    std: float | None
    minimum: float
    maximum: float
    interval: Interval | None


def summarise(values: Numbers, seed: int = 0) -> Summary | None:
    """Summarise the finite values; None if there are none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    several = len(finite) > 1
    return Summary(
        count=len(finite),
        mean=float(finite.mean()),
        median=float(np.median(finite)),
        std=float(finite.std(ddof=1)) if several else None,
        minimum=float(finite.min()),
        maximum=float(finite.max()),
        interval=bootstrap_mean(finite, seed) if several else None,
    )


def bootstrap_mean(values: Numbers, seed: int = 0, weights: Numbers | None = None) -> Interval:
    """Percentile bootstrap interval of the mean (B. Efron, Annals of Statistics 7, 1979).

    Equal values and an equal ``seed`` give an equal interval: that of ``scipy.stats.bootstrap``, which takes a second
    to load.

    Args:
        values: (n,) finite, n >= 2.
        seed: Seed of the resampling.
        weights: (n,) positive, drawn together with their values; None for a plain mean.
    """
    rng = np.random.default_rng(seed)
    at_once = max(1, _NUMBERS_AT_ONCE // len(values))
    means = []
    for start in range(0, RESAMPLES, at_once):
        drawn = rng.integers(0, len(values), (min(at_once, RESAMPLES - start), len(values)))
        if weights is None:
            means.append(values[drawn].mean(axis=-1))
        else:
            means.append((values[drawn] * weights[drawn]).sum(axis=-1) / weights[drawn].sum(axis=-1))
    tail = (1 - CONFIDENCE) / 2
    low, high = np.percentile(np.concatenate(means), (100 * tail, 100 * (1 - tail)))
    return Interval(float(low), float(high))


@dataclass(frozen=True, slots=True)
class Comparison:
    """The difference of two means (first minus second), and whether its sign is certain.

    Attributes:
        difference: Of the means.
        interval: Confidence interval of the difference.
        decided: Whether the interval excludes 0.
        repeats_to_decide: The fewest repeats of each group with which the interval would exclude 0, at the present
            difference and spread; None if the means are equal or if a million repeats are not enough.
    """

    difference: float
    interval: Interval
    decided: bool
    repeats_to_decide: int | None


def compare_means(first: Numbers, second: Numbers, confidence: float = CONFIDENCE) -> Comparison:
    """Welch's interval of the difference of two means (B. L. Welch, Biometrika 34, 1947), and the repeats needed.

    Args:
        first: (n,) finite, n >= 2.
        second: (m,) finite, m >= 2.
        confidence: Confidence of the interval.

    Raises:
        InvalidInput: for fewer than two values in a group.
    """
    counts = len(first), len(second)
    if min(counts) < 2:
        raise InvalidInput(
            f"a comparison needs two runs of each, found {counts[0]} and {counts[1]}", "add repeats to the experiment"
        )
    difference = float(first.mean() - second.mean())
    variances = float(first.var(ddof=1)), float(second.var(ddof=1))
    half_width = _half_width(variances, counts, confidence)
    return Comparison(
        difference,
        Interval(difference - half_width, difference + half_width),
        half_width < abs(difference),
        _repeats(abs(difference), variances, confidence),
    )


def student_factors(most: int) -> list[float]:
    """Factors of Student's interval at :data:`CONFIDENCE`, for 1 to ``most`` degrees of freedom."""
    return [round(float(scipy.special.stdtrit(freedom, (1 + CONFIDENCE) / 2)), 5) for freedom in range(1, most + 1)]


def means_differ(first: tuple[int, float, float], second: tuple[int, float, float]) -> bool:
    """What :func:`compare_means` decides, from number (>= 2), mean and sample variance of each group."""
    half_width = _half_width((first[2], second[2]), (first[0], second[0]), CONFIDENCE)
    return half_width < abs(first[1] - second[1])


def _half_width(variances: tuple[float, float], counts: tuple[int, int], confidence: float) -> float:
    """Half of Welch's interval. scipy has it for samples alone; here also for repeats that are yet to be made."""
    parts = [variance / count for variance, count in zip(variances, counts, strict=True)]
    if sum(parts) == 0:
        return 0.0
    freedom = sum(parts) ** 2 / sum(part**2 / (count - 1) for part, count in zip(parts, counts, strict=True))
    return float(scipy.special.stdtrit(freedom, (1 + confidence) / 2)) * math.sqrt(sum(parts))


def _repeats(difference: float, variances: tuple[float, float], confidence: float) -> int | None:
    """The fewest repeats of each group at which half of the interval is below ``difference``."""
    possible = range(2, MOST_REPEATS + 1)
    found = bisect_left(
        possible, True, key=lambda count: _half_width(variances, (count, count), confidence) < difference
    )
    return possible[found] if found < len(possible) else None


@dataclass(frozen=True, slots=True)
class RankTest:
    """Ranks of competitors over blocks (1 is best), Friedman's test, and which pairs differ.

    Attributes:
        mean_ranks: (competitors,).
        p_value: Of Friedman's test.
        critical_difference: Nemenyi's, of mean ranks; None for the test of Wilcoxon and Holm.
        pairs: {(first, second): p value}, by position and corrected for the number of pairs.
        significance: Level of the tests.
    """

    mean_ranks: Numbers
    p_value: float
    critical_difference: float | None
    pairs: dict[tuple[int, int], float]
    significance: float

    def same(self, first: int, second: int) -> bool:
        """Whether the test finds no difference between two competitors."""
        key = (min(first, second), max(first, second))
        if self.critical_difference is not None:
            return bool(abs(self.mean_ranks[first] - self.mean_ranks[second]) < self.critical_difference)
        return self.pairs[key] >= self.significance

    def cliques(self) -> list[tuple[int, ...]]:
        """The largest groups of two or more neighbours in rank without a difference between any two of them."""
        order = [int(place) for place in np.argsort(self.mean_ranks, kind="stable")]
        found: list[tuple[int, ...]] = []
        for start in range(len(order)):
            end = start
            while end + 1 < len(order) and all(self.same(order[end + 1], order[i]) for i in range(start, end + 1)):
                end += 1
            clique = tuple(order[start : end + 1])
            if len(clique) > 1 and not any(set(clique) <= set(known) for known in found):
                found.append(clique)
        return found


def rank_test(scores: Numbers, test: str = "nemenyi", significance: float = 0.05) -> RankTest:
    """Compare competitors over blocks after J. Demsar, JMLR 7 (2006), equations 1 to 4.

    Args:
        scores: (blocks, competitors), lower is better, finite. Give failures the worst score beforehand.
        test: ``nemenyi``, or ``wilcoxon-holm`` (A. Benavoli et al., JMLR 17, 2016).
        significance: Level of the tests.

    Raises:
        InvalidInput: for fewer than three competitors or two blocks.
    """
    blocks, competitors = scores.shape
    if competitors < 3 or blocks < 2:
        raise InvalidInput(
            f"Friedman's test needs three competitors over two datasets or more, found {competitors} over {blocks}",
            "widen the selection",
        )
    mean_ranks = scipy.stats.rankdata(scores, axis=1).mean(axis=0)
    with np.errstate(invalid="ignore"):
        p_value = float(scipy.stats.friedmanchisquare(*scores.T).pvalue)
    p_value = 1.0 if math.isnan(p_value) else p_value  # scipy divides 0 by 0 where all scores are tied
    if test == "wilcoxon-holm":
        return RankTest(mean_ranks, p_value, None, _wilcoxon_holm(scores), significance)
    unit = math.sqrt(competitors * (competitors + 1) / (12 * blocks))
    critical = float(scipy.stats.studentized_range.ppf(1 - significance, competitors, np.inf)) * unit
    return RankTest(mean_ranks, p_value, critical, _nemenyi(mean_ranks, unit), significance)


def _nemenyi(mean_ranks: Numbers, unit: float) -> dict[tuple[int, int], float]:
    pairs = list(combinations(range(len(mean_ranks)), 2))
    distances = [abs(mean_ranks[first] - mean_ranks[second]) / unit for first, second in pairs]
    # Each takes milliseconds, and most are equal, because ranks are counted.
    distinct, places = np.unique(np.round(distances, 12), return_inverse=True)
    p_values = scipy.stats.studentized_range.sf(distinct, len(mean_ranks), np.inf)[places]
    return dict(zip(pairs, map(float, p_values), strict=True))


def _wilcoxon_holm(scores: Numbers) -> dict[tuple[int, int], float]:
    """Wilcoxon's signed-rank test of each pair, with Holm's correction."""
    pairs = list(combinations(range(scores.shape[1]), 2))
    differences = [scores[:, first] - scores[:, second] for first, second in pairs]
    return dict(zip(pairs, holm([_signed_ranks(entry) for entry in differences]), strict=True))


def _signed_ranks(differences: Numbers) -> float:
    """The p value of Wilcoxon's signed-rank test, as ``scipy.stats.wilcoxon`` computes it.

    SciPy sums the ranks of few differences with ties again for each combination of signs, which takes seconds.
    """
    nonzero = differences[differences != 0]
    sizes = np.abs(nonzero)
    if not len(nonzero):
        return 1.0
    if len(differences) > _MOST_ENUMERATED or len(np.unique(sizes)) == len(differences):
        return float(scipy.stats.wilcoxon(differences).pvalue)
    ranks = np.rint(2 * scipy.stats.rankdata(sizes)).astype(int)  # tied ranks are halves
    ways = np.zeros(ranks.sum() + 1)
    ways[0] = 1
    for rank in ranks:
        ways[rank:] += ways[: len(ways) - rank].copy()
    found = ranks[nonzero > 0].sum()
    return float(min(1.0, 2 * min(ways[: found + 1].sum(), ways[found:].sum()) / 2 ** len(ranks)))


def holm(p_values: Sequence[float]) -> list[float]:
    """The p values, corrected step by step for their number (S. Holm, Scandinavian Journal of Statistics 6, 1979)."""
    corrected = [0.0] * len(p_values)
    largest = 0.0
    for rank, place in enumerate(sorted(range(len(p_values)), key=lambda place: p_values[place])):
        largest = max(largest, min(1.0, p_values[place] * (len(p_values) - rank)))
        corrected[place] = largest
    return corrected
