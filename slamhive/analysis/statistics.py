"""Summaries, intervals and rank tests. Arrays in, numbers out; what cannot be computed is None, never 0."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from slamhive.errors import InvalidInput

Numbers = NDArray[np.float64]

RESAMPLES = 2_000
CONFIDENCE = 0.95
MOST_REPEATS = 1_000_000


@dataclass(frozen=True, slots=True)
class Interval:
    """A confidence interval, both ends included."""

    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Summary:
    """What a group of values comes to. ``std`` (divisor n - 1) and ``interval`` of the mean need two values."""

    count: int
    mean: float
    median: float
    std: float | None
    minimum: float
    maximum: float
    interval: Interval | None


def summarise(values: Numbers, seed: int = 0) -> Summary | None:
    """The summary of the finite values; None if there are none."""
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


def bootstrap_mean(values: Numbers, seed: int = 0, confidence: float = CONFIDENCE) -> Interval:
    """Percentile bootstrap interval of the mean (B. Efron, Annals of Statistics 7, 1979); the same for equal input.

    Args:
        values: (n,) finite, n of two or more.
        seed: Of the resampling.
        confidence: Share of the distribution between the ends.
    """
    draws = np.random.default_rng(seed)
    means = np.empty(RESAMPLES)
    step = max(1, 1_000_000 // len(values))
    for start in range(0, RESAMPLES, step):
        stop = min(start + step, RESAMPLES)
        means[start:stop] = values[draws.integers(0, len(values), (stop - start, len(values)))].mean(axis=1)
    tail = (1 - confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return Interval(float(low), float(high))


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two groups: the difference of their means (first minus second) and how sure its sign is.

    ``repeats_to_decide``: how many repeats of each would, at the spread seen, make the interval of the difference
    exclude 0 if the difference stays as it is; None if the means are equal or a million repeats would not do.
    ``decided``: the interval excludes it already.
    """

    difference: float
    interval: Interval
    decided: bool
    repeats_to_decide: int | None


def compare_means(first: Numbers, second: Numbers, confidence: float = CONFIDENCE) -> Comparison:
    """Welch's interval of the difference of two means (B. L. Welch, Biometrika 34, 1947), and the repeats needed.

    Args:
        first: (n,) finite, n of two or more.
        second: (m,) finite, m of two or more.
        confidence: Of the interval.

    Raises:
        InvalidInput: for fewer than two values in a group.
    """
    if len(first) < 2 or len(second) < 2:
        raise InvalidInput(
            f"comparing needs two runs of each, found {len(first)} and {len(second)}", "add repeats to the experiment"
        )
    difference = float(first.mean() - second.mean())
    variances = first.var(ddof=1), second.var(ddof=1)
    error = math.sqrt(variances[0] / len(first) + variances[1] / len(second))
    reach = _critical(variances, (len(first), len(second)), confidence) * error
    needed = None
    if difference:
        needed = _repeats(abs(difference), variances, confidence)
    return Comparison(difference, Interval(difference - reach, difference + reach), reach < abs(difference), needed)


def _critical(variances: tuple[float, float], counts: tuple[int, int], confidence: float) -> float:
    parts = [variance / count for variance, count in zip(variances, counts, strict=True)]
    if sum(parts) == 0:
        return 0.0
    freedom = sum(parts) ** 2 / sum(part**2 / (count - 1) for part, count in zip(parts, counts, strict=True))
    return float(stats.t.ppf((1 + confidence) / 2, freedom))


def _repeats(difference: float, variances: tuple[float, float], confidence: float) -> int | None:
    """The smallest number of repeats, the same for both, at which the interval's reach falls below the difference."""
    low, high = 2, 2
    while _reach(variances, high, confidence) >= difference:
        high *= 2
        if high > MOST_REPEATS:
            return None
    while low < high:
        middle = (low + high) // 2
        if _reach(variances, middle, confidence) < difference:
            high = middle
        else:
            low = middle + 1
    return low


def _reach(variances: tuple[float, float], count: int, confidence: float) -> float:
    return _critical(variances, (count, count), confidence) * math.sqrt(sum(variances) / count)


@dataclass(frozen=True, slots=True)
class RankTest:
    """Ranks of treatments over blocks (1 is best), Friedman's test, and which pairs differ.

    ``p_value`` is Friedman's. ``critical_difference`` of mean ranks is Nemenyi's, None for Wilcoxon-Holm.
    ``pairs`` holds for each pair of treatments (by position) the p value, corrected for their number.
    """

    mean_ranks: Numbers
    p_value: float
    critical_difference: float | None
    pairs: dict[tuple[int, int], float]
    significance: float

    def same(self, first: int, second: int) -> bool:
        """Whether two treatments cannot be told apart."""
        key = (min(first, second), max(first, second))
        if self.critical_difference is not None:
            return bool(abs(self.mean_ranks[first] - self.mean_ranks[second]) < self.critical_difference)
        return self.pairs[key] >= self.significance

    def cliques(self) -> list[tuple[int, ...]]:
        """The largest sets of neighbours in rank among which no two can be told apart, of two or more."""
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
    """Compare treatments over blocks after J. Demsar, JMLR 7 (2006), equations 1 to 4.

    Args:
        scores: (blocks, treatments), lower is better, finite (a failure is given the worst score beforehand).
        test: ``nemenyi``, or ``wilcoxon-holm`` (A. Benavoli et al., JMLR 17, 2016).
        significance: Level of the tests.

    Raises:
        InvalidInput: for fewer than three treatments or two blocks.
    """
    blocks, treatments = scores.shape
    if treatments < 3 or blocks < 2:
        raise InvalidInput(
            f"Friedman's test needs three competitors over two datasets or more, found {treatments} over {blocks}",
            "widen the selection",
        )
    ranks = stats.rankdata(scores, axis=1)
    mean_ranks = ranks.mean(axis=0)
    p_value = _friedman(ranks)
    if test == "nemenyi":
        quantile = float(stats.studentized_range.ppf(1 - significance, treatments, np.inf)) / math.sqrt(2)
        critical = quantile * math.sqrt(treatments * (treatments + 1) / (6 * blocks))
        return RankTest(mean_ranks, p_value, critical, _nemenyi(mean_ranks, blocks), significance)
    return RankTest(mean_ranks, p_value, None, _wilcoxon_holm(scores), significance)


def _friedman(ranks: Numbers) -> float:
    """Friedman's chi-square with the correction for ties; 1 if all ranks are tied."""
    blocks, treatments = ranks.shape
    centred = ranks.mean(axis=0) - (treatments + 1) / 2
    spread = float(((ranks - (treatments + 1) / 2) ** 2).sum()) / (blocks * (treatments - 1))
    if spread == 0:
        return 1.0
    statistic = blocks * float((centred**2).sum()) / spread
    return float(stats.chi2.sf(statistic, treatments - 1))


def _nemenyi(mean_ranks: Numbers, blocks: int) -> dict[tuple[int, int], float]:
    treatments = len(mean_ranks)
    unit = math.sqrt(treatments * (treatments + 1) / (6 * blocks))
    pairs: dict[tuple[int, int], float] = {}
    for first, second in combinations(range(treatments), 2):
        distance = abs(mean_ranks[first] - mean_ranks[second]) / unit * math.sqrt(2)
        pairs[first, second] = float(stats.studentized_range.sf(distance, treatments, np.inf))
    return pairs


def _wilcoxon_holm(scores: Numbers) -> dict[tuple[int, int], float]:
    """Wilcoxon's signed-rank test for each pair, the p values corrected step by step (S. Holm, 1979)."""
    raw: list[tuple[float, tuple[int, int]]] = []
    for first, second in combinations(range(scores.shape[1]), 2):
        differences = scores[:, first] - scores[:, second]
        result: Any = stats.wilcoxon(differences) if np.any(differences) else None
        raw.append((1.0 if result is None else float(result.pvalue), (first, second)))
    raw.sort()
    corrected: dict[tuple[int, int], float] = {}
    largest = 0.0
    for place, (p_value, pair) in enumerate(raw):
        largest = max(largest, min(1.0, p_value * (len(raw) - place)))
        corrected[pair] = largest
    return corrected
