"""How much of the recording the estimate covers, how often tracking was lost, and a score of both."""

from __future__ import annotations

import numpy as np

from slamhive.domain.metrics.trajectories import SCORE_LIMIT_M
from slamhive.domain.protocol import Association
from slamhive.evaluation.evaluators.base import MetricValues, Paired
from slamhive.trajectory.completeness import covers, measure_completeness, measure_own_coverage
from slamhive.trajectory.model import FloatArray


class Coverage:
    """Coverage and gaps, by the protocol's gap threshold and by the estimate's own spacing."""

    keys = ("tracked_fraction", "gap.max", "gap.count", "tracked.path", "tracked.time", "gap.own")

    def evaluate(self, paired: Paired) -> MetricValues:
        """Measure over the time span of the whole ground truth."""
        found = measure_completeness(
            paired.estimate.stamps_s, paired.reference.stamps_s, paired.protocol.gap_threshold_s
        )
        own = measure_own_coverage(paired.estimate.stamps_s, paired.reference, paired.protocol.gap_threshold_s)
        return MetricValues(
            {
                "tracked_fraction": found.tracked_fraction,
                "gap.max": found.longest_gap_s,
                "gap.count": float(found.gap_count),
                "tracked.path": own.path_share,
                "tracked.time": own.time_share,
                "gap.own": own.gap_s,
            }
        )


class Robustness:
    """Time to the first pose, losses of tracking, completeness-aware score."""

    keys = ("time_to_first_pose", "tracking.losses", "completeness.score")

    def evaluate(self, paired: Paired) -> MetricValues:
        """There is no score if the poses of the ground truth are further apart than the gap threshold."""
        start_s, end_s = float(paired.reference.stamps_s[0]), float(paired.reference.stamps_s[-1])
        gap_s = paired.protocol.gap_threshold_s
        values = {
            "time_to_first_pose": max(0.0, float(paired.estimate.stamps_s[0]) - start_s),
            "tracking.losses": float(count_losses(paired.estimate.stamps_s, start_s, end_s, gap_s)),
        }
        steps_s = np.diff(paired.reference.stamps_s)
        known_s = float(steps_s[steps_s <= gap_s].sum())
        if known_s == 0:
            reason = f"the poses of the ground truth are more than {gap_s:g} s apart, the gap threshold"
            return MetricValues(values, {"completeness.score": reason})
        covered_s = score_seconds(paired.matched_reference.stamps_s, _errors_m(paired), gap_s, SCORE_LIMIT_M)
        return MetricValues({**values, "completeness.score": covered_s / known_s})


def _errors_m(paired: Paired) -> FloatArray:
    """Errors of the matched poses; infinite where the protocol holds a pose although the estimate has none."""
    errors_m = np.linalg.norm(paired.aligned.positions_m - paired.matched_reference.positions_m, axis=1)
    if paired.protocol.association is Association.HOLD:
        stamps_s = paired.matched_reference.stamps_s
        errors_m[~covers(paired.estimate.stamps_s, stamps_s, paired.protocol.gap_threshold_s)] = np.inf
    return np.asarray(errors_m)


def count_losses(stamps_s: FloatArray, start_s: float, end_s: float, gap_s: float) -> int:
    """Gaps longer than ``gap_s`` between poses inside the span, and one more if the poses end that long before it."""
    gaps_s = np.diff(np.append(np.clip(stamps_s, start_s, end_s), end_s))
    return int(np.count_nonzero(gaps_s > gap_s))


def score_seconds(stamps_s: FloatArray, errors_m: FloatArray, gap_s: float, limit_m: float) -> float:
    """Time integral of max(0, 1 - error / limit), which is the area under "time within x" up to the limit, over it.

    For one error e the share within x is a step at e, and the area under it from 0 to the limit is limit - e. Errors
    are interpolated between matched poses no further apart than ``gap_s``; longer times are left out. Where the error
    crosses the limit between two poses, only the triangle on the side of the smaller error counts.

    Args:
        stamps_s: Of the matched poses, never decreasing, shape (n,).
        errors_m: Their errors, shape (n,).
        gap_s: A longer time without a pose is not tracked.
        limit_m: Larger errors are as bad as no pose.
    """
    goodness = 1.0 - errors_m / limit_m
    steps_s = np.diff(stamps_s)
    tracked = (steps_s <= gap_s) & (np.maximum(goodness[:-1], goodness[1:]) > 0)
    better, worse = (choose(goodness[:-1], goodness[1:])[tracked] for choose in (np.maximum, np.minimum))
    crossing = worse < 0
    means = (better + worse) / 2.0
    means[crossing] = better[crossing] ** 2 / (2.0 * (better[crossing] - worse[crossing]))
    return float((steps_s[tracked] * means).sum())
