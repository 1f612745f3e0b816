"""Measures how much of the recording the estimate covers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamhive.base.errors import InvalidInput
from slamhive.trajectory.model import FloatArray, Poses

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Completeness:
    """Coverage of the ground truth's time span.

    Attributes:
        tracked_fraction: Share of the span between poses that are no further apart than the threshold, 0..1.
        longest_gap_s: Longest time without a pose inside the span, its start and end included.
        gap_count: How many times without a pose are longer than the threshold, start and end included.
    """

    tracked_fraction: float
    longest_gap_s: float
    gap_count: int


OWN_INTERVALS = 10.0
"""A gap of an estimate is longer than this many times the median interval between its poses."""
LARGEST_OWN_SHARE = 0.1
"""A larger share of the recording without a pose is always a gap."""


@dataclass(frozen=True, slots=True)
class OwnCoverage:
    """Coverage judged by the spacing of the estimate itself: keyframes are further apart than frames.

    Attributes:
        path_share: Share of the true path between poses no further apart than ``gap_s``, 0..1.
        time_share: The same of the time.
        gap_s: A longer time without a pose is a gap.
    """

    path_share: float
    time_share: float
    gap_s: float


def covers(estimate_stamps_s: FloatArray, stamps_s: FloatArray, gap_s: float) -> BoolArray:
    """Tell if there is a pose at each of ``stamps_s``, or poses on both sides, no further apart than ``gap_s``."""
    if len(estimate_stamps_s) == 1:
        return np.asarray(stamps_s == estimate_stamps_s[0])
    after = np.clip(np.searchsorted(estimate_stamps_s, stamps_s), 1, len(estimate_stamps_s) - 1)
    before_s, after_s = estimate_stamps_s[after - 1], estimate_stamps_s[after]
    inside = (before_s <= stamps_s) & (stamps_s <= after_s) & (after_s - before_s <= gap_s)
    return np.asarray(inside | (stamps_s == before_s) | (stamps_s == after_s))


def measure_completeness(estimate_stamps_s: FloatArray, reference_stamps_s: FloatArray, gap_s: float) -> Completeness:
    """Coverage of the reference's span by the estimate.

    Args:
        estimate_stamps_s: Never decreasing, shape (n,), n >= 1; timestamps outside the span do not count.
        reference_stamps_s: Never decreasing, shape (m,).
        gap_s: A longer time without a pose is a gap.

    Raises:
        InvalidInput: The reference has no time span.
    """
    start_s, end_s = float(reference_stamps_s[0]), float(reference_stamps_s[-1])
    if end_s <= start_s:
        raise InvalidInput("the ground truth has one pose, which spans no time", "use a ground truth of several poses")
    begins_s = np.clip(estimate_stamps_s[:-1], start_s, end_s)
    ends_s = np.clip(estimate_stamps_s[1:], start_s, end_s)
    inner_s = ends_s - begins_s
    tracked = np.diff(estimate_stamps_s) <= gap_s
    before_s = max(0.0, min(float(estimate_stamps_s[0]), end_s) - start_s)
    after_s = max(0.0, end_s - max(float(estimate_stamps_s[-1]), start_s))
    pauses_s = np.concatenate(([before_s], inner_s, [after_s]))
    fraction = float(inner_s[tracked].sum()) / (end_s - start_s)
    return Completeness(
        tracked_fraction=min(1.0, max(0.0, fraction)),
        longest_gap_s=float(pauses_s.max()),
        gap_count=int(np.count_nonzero(pauses_s > gap_s)),
    )


def measure_own_coverage(estimate_stamps_s: FloatArray, reference: Poses, gap_s: float) -> OwnCoverage:
    """Coverage of the reference's path and time by the estimate, gaps judged by the estimate's own spacing.

    Args:
        estimate_stamps_s: Strictly increasing, shape (n,), n >= 1; timestamps outside the span do not count.
        reference: At least two poses that span some time.
        gap_s: No time shorter than this is a gap.
    """
    stamps_s = reference.stamps_s
    own_gap_s = own_gap(estimate_stamps_s, reference.span_s, gap_s)
    # In a gap of the ground truth nobody knows the path: the mean speed of the rest is taken.
    steps_s = np.diff(reference.stamps_s)
    steps = np.linalg.norm(np.diff(reference.positions_m, axis=0), axis=1)
    known = steps_s <= own_gap(stamps_s, reference.span_s, gap_s)
    if steps[known].any():
        steps[~known] = steps[known].sum() / steps_s[known].sum() * steps_s[~known]
    else:
        # Where nothing moves at all, time takes the place of path.
        steps = steps_s
    travelled = np.concatenate(([0.0], np.cumsum(steps)))
    begins_s = np.clip(estimate_stamps_s[:-1], stamps_s[0], stamps_s[-1])
    ends_s = np.clip(estimate_stamps_s[1:], stamps_s[0], stamps_s[-1])
    tracked = np.diff(estimate_stamps_s) <= own_gap_s
    lengths = np.interp(ends_s, stamps_s, travelled) - np.interp(begins_s, stamps_s, travelled)
    return OwnCoverage(
        path_share=min(1.0, float(lengths[tracked].sum() / travelled[-1])),
        time_share=min(1.0, float((ends_s - begins_s)[tracked].sum() / reference.span_s)),
        gap_s=own_gap_s,
    )


def own_gap(stamps_s: FloatArray, span_s: float, gap_s: float) -> float:
    """The gap threshold that follows from the spacing of the timestamps, within limits."""
    if len(stamps_s) < 2:
        return gap_s
    typical_s = float(np.median(np.diff(stamps_s)))
    return max(gap_s, min(OWN_INTERVALS * typical_s, LARGEST_OWN_SHARE * span_s))
