"""Tests for values worse than a baseline's: with a margin, over several configurations.

Two questions are asked of each metric, each with a p value. Did it become worse by more than the margin? Did it stay
within the margin? If neither can be affirmed, nothing is decided.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from slamhive.analysis.statistics import CONFIDENCE, RESAMPLES, Interval, Numbers, holm
from slamhive.domain.gate import Answer, Margin

_ARRANGEMENTS = 9_999
"""With ties, all ways to divide the values into two groups are counted, or so many at random if there are more."""
_MOST_EXACT = 2_500
"""Up to this product of the sizes, the distribution without ties is exact, and normal beyond."""
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class Sample:
    """One metric in one configuration. Larger values are worse, and those of failed runs are infinite.

    Attributes:
        baseline: (n,)
        candidate: (m,)
    """

    baseline: Numbers
    candidate: Numbers


@dataclass(frozen=True, slots=True)
class FailureCounts:
    """Failed runs, and all runs, of one configuration."""

    baseline_failed: int
    baseline: int
    candidate_failed: int
    candidate: int

    @property
    def excess(self) -> float:
        """By how much the share of failed runs is larger than in the baseline."""
        return self.candidate_failed / self.candidate - self.baseline_failed / self.baseline


@dataclass(frozen=True, slots=True)
class Evidence:
    """p values against "it did not become worse by more than the margin" and "it did"."""

    worse: float
    within: float


@dataclass(frozen=True, slots=True)
class Change:
    """A typical change over configurations: a share for a relative margin, else in the unit of the metric."""

    value: float
    interval: Interval | None


def rank_evidence(sample: Sample, margin: Margin) -> Evidence:
    """The one-sided tests of H. B. Mann and D. R. Whitney (1947), with the baseline moved by the margin.

    Ranks need no assumption about the distribution, and the infinite error of a failed run has a rank.
    """
    allowed = with_allowance(sample.baseline, margin)
    return Evidence(_p_larger(sample.candidate, allowed), _p_larger(allowed, sample.candidate))


def with_allowance(values: Numbers, margin: Margin) -> Numbers:
    """The values, (n,), moved by the margin; infinite ones stay."""
    sizes = np.where(np.isfinite(values), np.abs(values), 0.0)
    moved: Numbers = values + (margin.value * sizes if margin.relative else margin.value)
    return moved


def failure_evidence(counts: FailureCounts, margin: Margin) -> Evidence:
    """R. A. Fisher's exact test of the numbers of failed runs.

    A few runs can never prove that failures are rare. So ``within`` is 0 if the share of failed runs is not above that
    of the baseline by more than the margin, and 1 otherwise.
    """
    if counts.excess <= margin.value + _ROUNDING:
        return Evidence(1.0, 0.0)
    table = [
        [counts.candidate_failed, counts.candidate - counts.candidate_failed],
        [counts.baseline_failed, counts.baseline - counts.baseline_failed],
    ]
    return Evidence(float(scipy.stats.fisher_exact(table, alternative="greater").pvalue), 1.0)


def over_configurations(evidence: Sequence[Evidence], weights: Sequence[float]) -> Evidence:
    """Join the evidence of several configurations, whose runs are independent.

    A metric is worse if it is clearly worse in one configuration (L. H. C. Tippett, 1931) or a little in many (R. A.
    Fisher, 1932). Both are asked, so the smaller p value counts twice. It is within the margin if it is so on the whole
    (S. A. Stouffer, 1949). ``weights`` are those of Stouffer's method.
    """
    if len(evidence) == 1:
        return evidence[0]
    worse = [entry.worse for entry in evidence]
    p_worse = min(float(scipy.stats.combine_pvalues(worse, method).pvalue) for method in ("tippett", "fisher"))
    within = [max(entry.within, np.finfo(float).tiny) for entry in evidence]
    p_within = float(scipy.stats.combine_pvalues(within, "stouffer", weights=weights).pvalue)
    return Evidence(min(1.0, 2 * p_worse), p_within)


def decide(evidence: Mapping[str, Evidence], significance: float) -> dict[str, tuple[Answer, float]]:
    """The answer for each metric, with the p value of "worse" after S. Holm's correction (1979).

    The chance that any metric is falsely called worse is ``significance`` at most. Passing needs no correction, because
    a gate passes only if all metrics do.
    """
    level = significance * (1 + _ROUNDING)
    corrected = dict(zip(evidence, holm([entry.worse for entry in evidence.values()]), strict=True))
    return {
        key: (
            Answer.WORSE if corrected[key] <= level else Answer.PASS if entry.within <= level else Answer.UNDECIDED,
            corrected[key],
        )
        for key, entry in evidence.items()
    }


def typical_change(pairs: Sequence[tuple[Numbers, Numbers]], *, relative: bool, seed: int = 0) -> Change | None:
    """The change of the median from a baseline: its geometric mean over configurations, or the mean if not relative.

    Args:
        pairs: Finite values of the baseline and of the candidate, shapes (n,) and (m,), for each configuration.
        relative: Ratios less 1 instead of differences.
        seed: Of the percentile bootstrap, which gives the interval where every group has two values.

    Returns:
        None without values, and for a relative change of values that are not above 0.
    """
    samples = [values for pair in pairs for values in pair]
    if not samples or any(not len(values) for values in samples):
        return None
    if relative and any(np.min(values) <= 0 for values in samples):
        return None

    def shift(*groups: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
        medians = np.stack([np.median(group, axis=axis) for group in groups])
        medians = np.log(medians) if relative else medians
        moved: NDArray[np.float64] = (medians[1::2] - medians[0::2]).mean(axis=0)
        return np.expm1(moved) if relative else moved

    value = float(shift(*samples))
    if any(len(values) < 2 for values in samples):
        return Change(value, None)
    found = scipy.stats.bootstrap(
        samples,
        shift,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Change(value, Interval(float(found.low), float(found.high)))


def _p_larger(first: Numbers, second: Numbers) -> float:
    """The p value of "values of ``first`` are larger"; 1 for a single value, and if all are equal."""
    if min(len(first), len(second)) < 2:
        return 1.0
    ranks = scipy.stats.rankdata(np.concatenate([first, second]))
    distinct = len(np.unique(ranks))
    if distinct == 1:
        return 1.0
    parts = ranks[: len(first)], ranks[len(first) :]
    if distinct < len(ranks):
        test = scipy.stats.permutation_test(
            parts,
            lambda chosen, _, axis: np.sum(chosen, axis=axis),
            vectorized=True,
            n_resamples=_ARRANGEMENTS,
            alternative="greater",
            rng=np.random.default_rng(0),
        )
        return float(test.pvalue)
    method = "exact" if len(first) * len(second) <= _MOST_EXACT else "asymptotic"
    return float(scipy.stats.mannwhitneyu(*parts, alternative="greater", method=method).pvalue)


# Whether repeats of runs agree with what was recorded: two one-sided tests (TOST) against a margin.
#
# After D. J. Schuirmann (1987): values agree if they are shown to be below the upper end of the margin, and above its
# lower end. They differ if they are shown to be beyond one of the two. "No significant difference" is no agreement.


def rank_equivalence(sample: Sample, margin: Margin) -> Evidence:
    """Evidence against "they are within the margin" (``worse``, in either direction) and against "they are not".

    Both directions are those of the gate: the second has recorded runs and repeats in each other's place. A single
    recorded value is no sample. It is taken as a claim, and the median of the repeats is tested against it.
    """
    if len(sample.baseline) == 1:
        claimed = float(sample.baseline[0])
        if not len(sample.candidate):
            return Evidence(1.0, 1.0)
        above, below = with_allowance(np.array([claimed]), margin), with_allowance(sample.candidate, margin)
        beyond = min(_p_most(sample.candidate > above), _p_most(below < claimed))
        return Evidence(min(1.0, 2 * beyond), max(_p_most(sample.candidate < above), _p_most(below > claimed)))
    swapped = Sample(sample.candidate, sample.baseline)
    return _both_ways(rank_evidence(sample, margin), rank_evidence(swapped, margin))


def failure_equivalence(counts: FailureCounts, margin: Margin) -> Evidence:
    """R. A. Fisher's exact test in both directions. Shares agree if they differ by no more than the margin."""
    swapped = FailureCounts(counts.candidate_failed, counts.candidate, counts.baseline_failed, counts.baseline)
    return _both_ways(failure_evidence(counts, margin), failure_evidence(swapped, margin))


def median_interval(values: Numbers) -> Interval | None:
    """An interval of the median that holds it with at least 95 %: order statistics, for any distribution.

    Args:
        values: (n,) finite.

    Returns:
        None for fewer than 6 values, from which no such interval follows.
    """
    rank = median_rank(len(values))
    if rank < 1:
        return None
    ordered = np.sort(values)
    return Interval(float(ordered[rank - 1]), float(ordered[-rank]))


def median_rank(count: int) -> int:
    """The rank of the values, from both ends, between which the median of ``count`` runs lies with at least 95 %.

    0 for fewer than 6, from which no such interval follows. See W. J. Conover, Practical Nonparametric Statistics,
    section 3.2.
    """
    return int(scipy.stats.binom.ppf((1 - CONFIDENCE) / 2, count, 0.5)) if count else 0


def _both_ways(first: Evidence, second: Evidence) -> Evidence:
    return Evidence(min(1.0, 2 * min(first.worse, second.worse)), max(first.within, second.within))


def _p_most(hits: NDArray[np.bool_]) -> float:
    """The p value of "more than half of the distribution does so"."""
    return float(scipy.stats.binom.sf(int(hits.sum()) - 1, len(hits), 0.5))
