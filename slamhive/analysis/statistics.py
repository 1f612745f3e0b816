"""Summaries, intervals and rank tests. Arrays in, numbers out; a value that cannot be computed is None, never 0."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy  # loads scipy.stats when it is first used: a second, which most plots do not need
from numpy.typing import NDArray

from slamhive.base.errors import InvalidInput

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
        p_value: Of Welch's test, two-sided; 0 if neither group varies and the means differ.
        repeats_to_decide: The fewest repeats of each group with which the interval would exclude 0, at the present
            difference and spread; None if the means are equal or if a million repeats are not enough.
    """

    difference: float
    interval: Interval
    decided: bool
    p_value: float
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
    samples = [(len(values), float(values.mean()), float(values.var(ddof=1))) for values in (first, second)]
    return compare_samples(samples[0], samples[1], confidence)


def compare_samples(
    first: tuple[int, float, float], second: tuple[int, float, float], confidence: float = CONFIDENCE
) -> Comparison:
    """Compare as :func:`compare_means` does, from number (>= 2), mean and sample variance of each group."""
    counts, variances = (first[0], second[0]), (first[2], second[2])
    difference = first[1] - second[1]
    half_width = _half_width(variances, counts, confidence)
    error, freedom = _standard_error(variances, counts)
    p_value = 0.0 if difference else 1.0  # of samples that do not vary
    if error:
        p_value = 2 * float(scipy.special.stdtr(freedom, -abs(difference) / error))
    return Comparison(
        difference,
        Interval(difference - half_width, difference + half_width),
        half_width < abs(difference),
        p_value,
        _repeats(abs(difference), variances, confidence),
    )


def student_factors(most: int) -> list[float]:
    """Factors of Student's interval at :data:`CONFIDENCE`, for 1 to ``most`` degrees of freedom."""
    return [round(float(scipy.special.stdtrit(freedom, (1 + CONFIDENCE) / 2)), 5) for freedom in range(1, most + 1)]


def means_differ(first: tuple[int, float, float], second: tuple[int, float, float]) -> bool:
    """Decide as :func:`compare_means` does, from number (>= 2), mean and sample variance of each group."""
    half_width = _half_width((first[2], second[2]), (first[0], second[0]), CONFIDENCE)
    return half_width < abs(first[1] - second[1])


def _half_width(variances: tuple[float, float], counts: tuple[int, int], confidence: float) -> float:
    """Half of Welch's interval. scipy has it for samples alone; here also for repeats that are yet to be made."""
    error, freedom = _standard_error(variances, counts)
    return float(scipy.special.stdtrit(freedom, (1 + confidence) / 2)) * error if error else 0.0


def _standard_error(variances: tuple[float, float], counts: tuple[int, int]) -> tuple[float, float]:
    """The standard error of the difference of two means, and its degrees of freedom; both 0 if nothing varies.

    The degrees are those of Welch and Satterthwaite (F. E. Satterthwaite, Biometrics Bulletin 2, 1946).
    """
    parts = [variance / count for variance, count in zip(variances, counts, strict=True)]
    if sum(parts) == 0:
        return 0.0, 0.0
    freedom = sum(parts) ** 2 / sum(part**2 / (count - 1) for part, count in zip(parts, counts, strict=True))
    return math.sqrt(sum(parts)), freedom


def shares_p_value(first: tuple[int, int], second: tuple[int, int]) -> float:
    """Fisher's exact test, two-sided, that two shares are equal (R. A. Fisher, JRSS 85, 1922).

    Args:
        first: How many of how many, such as failed runs of all runs.
        second: The same of the other group.
    """
    (hits, total), (others, more) = first, second
    together = hits + others
    ways = {
        count: math.comb(total, count) * math.comb(more, together - count)
        for count in range(max(0, together - more), min(total, together) + 1)
    }
    return sum(way for way in ways.values() if way <= ways[hits]) / math.comb(total + more, together)


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
        """True if the test finds no difference between two competitors."""
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
        pairs = list(combinations(range(scores.shape[1]), 2))
        differences = [scores[:, first] - scores[:, second] for first, second in pairs]
        p_values = holm([_signed_ranks(entry) for entry in differences])
        return RankTest(mean_ranks, p_value, None, dict(zip(pairs, p_values, strict=True)), significance)
    # Demsar's equation 4 has q / sqrt(2) times sqrt(k(k+1) / 6N), hence 12: q is the studentized range itself here.
    unit = math.sqrt(competitors * (competitors + 1) / (12 * blocks))
    critical = float(scipy.stats.studentized_range.ppf(1 - significance, competitors, np.inf)) * unit
    pairs = list(combinations(range(len(mean_ranks)), 2))
    distances = [abs(mean_ranks[first] - mean_ranks[second]) / unit for first, second in pairs]
    # Each takes milliseconds, and most are equal, because ranks are counted.
    distinct, places = np.unique(np.round(distances, 12), return_inverse=True)
    of_pairs = map(float, scipy.stats.studentized_range.sf(distinct, len(mean_ranks), np.inf)[places])
    return RankTest(mean_ranks, p_value, critical, dict(zip(pairs, of_pairs, strict=True)), significance)


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


# Ranks of competitors over the same sequences; those that no test separates share one.


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
    """Result of a paired test over sequences between two competitors.

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


# Analysis of variance for balanced and unbalanced designs: the share of the variance that each factor explains.


Codes = NDArray[np.intp]
Term = tuple[str, ...]
"""One factor, or two factors for their interaction."""

MOST_COLUMNS = 600
"""Levels of all terms in one model. A fit of more takes seconds, so pairs of weak factors are left out then."""

_RELATIVE_ZERO = 1e-10


@dataclass(frozen=True, slots=True)
class Effects:
    """Shares of the variance of one quantity, 0 to 1; None where the data do not determine a share.

    Attributes:
        names: The factors.
        main: Share of each factor, adjusted for all others.
        pairs: Share of each interaction: what two factors explain together beyond their own shares.
        shared: Share that several factors explain but that cannot be assigned to one; 0 for a balanced design.
        aliases: Factors that always vary together; each has the share of both.
        left_out: Number of interactions that are not in the model because there are too few values.
        count: Number of values.
    """

    names: tuple[str, ...]
    main: Mapping[str, float | None]
    pairs: Mapping[tuple[str, str], float | None]
    shared: float
    aliases: tuple[tuple[str, str], ...]
    left_out: int
    count: int


def explain_variance(codes: Mapping[str, Codes], values: Numbers) -> Effects:
    """Omega squared of every factor and of every interaction of two factors.

    One linear model contains all factors and interactions. The sum of squares of a term is what it adds to a model of
    all terms that do not contain it (type II: F. Yates, 1934; O. Langsrud, Statistics and Computing 13, 2003). For a
    balanced design these are the classical sums, which add up. Omega squared (W. L. Hays, 1963) subtracts what as many
    levels would explain by chance, estimated from the residual of the full model.

    Args:
        codes: The level of each value for each factor: (n,) integers from 0, without gaps.
        values: (n,) finite.
    """
    mains: list[Term] = [(name,) for name in codes]
    # A factor that determines another has no interaction with it.
    related = {
        (first, second): (_determines(codes[first], codes[second]) or _determines(codes[second], codes[first]))
        for first, second in combinations(codes, 2)
    }
    possible = [pair for pair, nested in related.items() if not nested]
    # Not all interactions may be affordable: those of the strongest factors, as long as degrees of freedom remain.
    design = _Design(codes, values, mains)
    left = {term[0]: design.fit([term]).residual for term in design.terms}
    columns = sum(map(design.levels, design.terms))
    rank = design.fit(design.terms).rank
    pairs = []
    for first, second in sorted(possible, key=lambda pair: left[pair[0]] + left[pair[1]]):
        levels = design.levels((first,)), design.levels((second,))
        freedom = (levels[0] - 1) * (levels[1] - 1)
        if columns + levels[0] * levels[1] <= MOST_COLUMNS and rank + freedom < design.count:
            pairs.append((first, second))
            columns, rank = columns + levels[0] * levels[1], rank + freedom
    design = _Design(codes, values, [*mains, *pairs])
    full = design.fit(design.terms)
    # A model with as many parameters as there are values leaves nothing to estimate the noise from.
    freedom = len(values) - full.rank
    noise = 0.0 if full.residual == 0 else full.residual / freedom if freedom > 0 else None
    shares = {term: _share(design, term, noise) for term in design.terms}
    beyond = 0.0 if full.residual == 0 else None  # without a residual, other interactions explain nothing
    return Effects(
        names=tuple(codes),
        main={name: shares[name,] for name in codes},
        pairs={pair: shares.get(pair, beyond) for pair in possible},
        shared=_shared(design, full),
        aliases=tuple(
            (first, second)
            for first, second in related
            if _determines(codes[first], codes[second]) and _determines(codes[second], codes[first])
        ),
        left_out=0 if beyond is not None else len(possible) - len(pairs),
        count=len(values),
    )


@dataclass(frozen=True, slots=True)
class _Fit:
    """A least-squares fit: the residual sum of squares, and the rank of the model."""

    residual: float
    rank: int


class _Design:
    """Least-squares fits of one quantity by any of ``terms``; sets up the normal equations once."""

    def __init__(self, codes: Mapping[str, Codes], values: Numbers, terms: Sequence[Term]) -> None:
        self.terms = tuple(terms)
        self.count = len(values)
        centred = values - values.mean() if len(values) else values
        self.total = float(centred @ centred)
        self._joint = {term: _joint([codes[name] for name in term]) for term in terms}
        blocks = [_indicators(np.zeros(len(values), dtype=np.intp)), *map(_indicators, self._joint.values())]
        matrix = scipy.sparse.hstack(blocks, format="csr")
        ends = np.cumsum([block.shape[1] for block in blocks])
        self._columns = dict(zip(terms, map(np.arange, ends[:-1], ends[1:]), strict=True))
        self._gram = (matrix.T @ matrix).toarray()
        self._moments = matrix.T @ centred
        self._fits: dict[frozenset[Term], _Fit] = {}

    def levels(self, term: Term) -> int:
        """Number of levels of a term."""
        return len(self._columns[term])

    def others(self, term: Term) -> list[Term]:
        """The terms that ``term`` is adjusted for: those that do not determine it."""
        inner = self._joint[term]
        return [
            other
            for other in self.terms
            if other != term and not set(other) >= set(term) and not _determines(self._joint[other], inner)
        ]

    def fit(self, terms: Sequence[Term]) -> _Fit:
        """The fit of an intercept and ``terms``, which may be collinear."""
        key = frozenset(terms)
        if key in self._fits:
            return self._fits[key]
        fit = _Fit(0.0, 1)
        if self.total != 0:
            columns = np.concatenate([[0], *(self._columns[term] for term in terms)]).astype(np.intp)
            weights, vectors = np.linalg.eigh(self._gram[np.ix_(columns, columns)])
            kept = weights > _RELATIVE_ZERO * weights[-1]
            along = vectors[:, kept].T @ self._moments[columns]
            residual = self.total - float((along**2 / weights[kept]).sum())
            fit = _Fit(residual if residual > _RELATIVE_ZERO * self.total else 0.0, int(kept.sum()))
        self._fits[key] = fit
        return fit


def _share(design: _Design, term: Term, noise: float | None) -> float | None:
    """Omega squared of ``term``; None if other terms determine it, or without a residual to estimate chance."""
    if design.total == 0:
        return 0.0
    explained, freedom = _own(design, term)
    if freedom < 1 or noise is None:
        return None
    return min(1.0, max(0.0, (explained - freedom * noise) / (design.total + noise)))


def _own(design: _Design, term: Term) -> tuple[float, int]:
    """The sum of squares that ``term`` adds to :meth:`_Design.others`, and its degrees of freedom."""
    others = design.others(term)
    without, along = design.fit(others), design.fit([*others, term])
    return without.residual - along.residual, along.rank - without.rank


def _shared(design: _Design, full: _Fit) -> float:
    """Share that the full model explains beyond the sums of its terms; never below 0."""
    if design.total == 0:
        return 0.0
    own = sum(_own(design, term)[0] for term in design.terms)
    rest = (design.total - full.residual - own) / design.total
    return rest if rest > _RELATIVE_ZERO * len(design.terms) else 0.0


def _joint(codes: Sequence[Codes]) -> Codes:
    """The joint levels of several factors, numbered from 0 without gaps."""
    joint = codes[0]
    for other in codes[1:]:
        joint = np.unique(joint * (int(other.max(initial=0)) + 1) + other, return_inverse=True)[1]
    return joint


def _indicators(codes: Codes) -> scipy.sparse.csr_array:
    """One column for each level, 1 where a value has that level."""
    return scipy.sparse.csr_array((np.ones(len(codes)), (np.arange(len(codes)), codes)))


def _determines(outer: Codes, inner: Codes) -> bool:
    """Tell if each level of ``outer`` implies one level of ``inner``."""
    said = np.zeros(int(outer.max(initial=-1)) + 1, dtype=inner.dtype)
    said[outer] = inner
    return bool((said[outer] == inner).all())
