"""How much of the recording the estimate covers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamhive.errors import InvalidInput
from slamhive.trajectory.model import FloatArray

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


def covers(estimate_stamps_s: FloatArray, stamps_s: FloatArray, gap_s: float) -> BoolArray:
    """Whether there is a pose at each of ``stamps_s``, or poses on both sides, no further apart than ``gap_s``."""
    if len(estimate_stamps_s) == 1:
        return np.asarray(stamps_s == estimate_stamps_s[0])
    after = np.clip(np.searchsorted(estimate_stamps_s, stamps_s), 1, len(estimate_stamps_s) - 1)
    before_s, after_s = estimate_stamps_s[after - 1], estimate_stamps_s[after]
    inside = (before_s <= stamps_s) & (stamps_s <= after_s) & (after_s - before_s <= gap_s)
    return np.asarray(inside | (stamps_s == before_s) | (stamps_s == after_s))


def measure_completeness(estimate_stamps_s: FloatArray, reference_stamps_s: FloatArray, gap_s: float) -> Completeness:
    """Coverage of the reference's span by the estimate.

    Args:
        estimate_stamps_s: Never decreasing, shape (n,), n >= 1; stamps outside the span do not count.
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
