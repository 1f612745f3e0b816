"""The score of the Hilti x Trimble SLAM Challenge 2026: 100 for no error, 1 for an error of 10 m, for each pose.

The organisers' site gives the formula. That errors are in metres, and how poses are matched, is from the local
evaluation script that a participant published with the repository of the challenge (``evaluate.py``).
"""

from __future__ import annotations

import numpy as np

from slamhive.domain.protocol import Alignment, Duplicates, Protocol
from slamhive.errors import InvalidInput
from slamhive.evaluation.evaluators.base import MetricValues, Paired
from slamhive.trajectory.alignment import align_umeyama
from slamhive.trajectory.model import FloatArray

HILTI = Protocol(Alignment.SE3, association_tolerance_s=0.05, duplicates=Duplicates.KEEP)
HIGHEST = 100.0
DECAY_PER_M = np.log(100.0) / 10.0
"""0.4605: the score of a pose is 1 at an error of 10 m."""
SKIPPED_S = 5.0
"""The LiDAR of the ground truth starts meanwhile."""
LEAST_COVERAGE = 0.99


class HiltiScore:
    """Mean over the poses of the ground truth of 100 exp(-0.4605 e), where e is the distance in metres."""

    keys = ("hilti.score",)

    def evaluate(self, paired: Paired) -> MetricValues:
        """Zero if less than 99 % of the ground truth after its first 5 s has a pose. Only under this protocol."""
        if paired.protocol != HILTI:
            return MetricValues({})
        truth, estimate = paired.reference, paired.estimate
        kept = truth.stamps_s >= truth.stamps_s[0] + SKIPPED_S
        if not kept.any():
            raise InvalidInput(f"the ground truth ends within its first {SKIPPED_S:g} s", "use a longer recording")
        stamps_s, positions_m = truth.stamps_s[kept], truth.positions_m[kept]
        nearest = _nearest(estimate.stamps_s, stamps_s)
        matched = np.abs(estimate.stamps_s[nearest] - stamps_s) <= HILTI.association_tolerance_s
        if np.mean(matched) < LEAST_COVERAGE:
            return MetricValues({"hilti.score": 0.0})
        estimated_m, true_m = estimate.positions_m[nearest[matched]], positions_m[matched]
        transform = align_umeyama(estimated_m, true_m, scaled=False)
        errors_m = np.linalg.norm(transform.points(estimated_m) - true_m, axis=1)
        return MetricValues({"hilti.score": float(np.mean(HIGHEST * np.exp(-DECAY_PER_M * errors_m)))})


def _nearest(stamps_s: FloatArray, wanted_s: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """For each of ``wanted_s`` the place of the nearest of the sorted ``stamps_s``; the earlier of two."""
    after = np.clip(np.searchsorted(stamps_s, wanted_s), 1, max(len(stamps_s) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stamps_s) - 1)
    return np.where(wanted_s - stamps_s[before] <= stamps_s[after] - wanted_s, before, after)
