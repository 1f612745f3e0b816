"""Whether repeats of runs agree with what was recorded: two one-sided tests (TOST) against a margin.

After D. J. Schuirmann (1987): values agree if they are shown to be below the upper end of the margin, and above its
lower end. They differ if they are shown to be beyond one of the two. "No significant difference" is no agreement.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from slamhive.analysis.regression import (
    Evidence,
    FailureCounts,
    Sample,
    failure_evidence,
    rank_evidence,
    with_allowance,
)
from slamhive.analysis.statistics import CONFIDENCE, Interval, Numbers
from slamhive.domain.gate import Margin


def rank_equivalence(sample: Sample, margin: Margin) -> Evidence:
    """Evidence against "they are within the margin" (``worse``, in either direction) and against "they are not".

    Both directions are those of the gate: the second has recorded runs and repeats in each other's place. A single
    recorded value is no sample. It is taken as a claim, and the median of the repeats is tested against it.
    """
    if len(sample.baseline) == 1:
        return _of_claim(float(sample.baseline[0]), sample.candidate, margin)
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
    rank = int(scipy.stats.binom.ppf((1 - CONFIDENCE) / 2, len(values), 0.5)) if len(values) else 0
    if rank < 1:
        return None
    ordered = np.sort(values)
    return Interval(float(ordered[rank - 1]), float(ordered[-rank]))


def _both_ways(first: Evidence, second: Evidence) -> Evidence:
    return Evidence(min(1.0, 2 * min(first.worse, second.worse)), max(first.within, second.within))


def _of_claim(claimed: float, values: Numbers, margin: Margin) -> Evidence:
    """The sign test of the median of ``values`` at both ends of the margin. A value at an end speaks for no side."""
    if not len(values):
        return Evidence(1.0, 1.0)
    above, below = with_allowance(np.array([claimed]), margin), with_allowance(values, margin)
    beyond = min(_p_most(values > above), _p_most(below < claimed))
    return Evidence(min(1.0, 2 * beyond), max(_p_most(values < above), _p_most(below > claimed)))


def _p_most(hits: NDArray[np.bool_]) -> float:
    """The p value of "more than half of the distribution does so"."""
    return float(scipy.stats.binom.sf(int(hits.sum()) - 1, len(hits), 0.5))
