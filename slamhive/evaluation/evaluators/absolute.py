"""Absolute errors besides those that evo computes: of orientations, and in relation to the path."""

from __future__ import annotations

import numpy as np

from slamhive.evaluation.evaluators.base import MetricValues, Paired, absent
from slamhive.evaluation.evaluators.pairs import statistics
from slamhive.trajectory.model import FloatArray
from slamhive.trajectory.transforms import rotation_angles_rad

_NAMES = ("rmse", "mean", "median", "max")


class RotationError:
    """ATE, rotation part: evo's APE with ``angle_deg``."""

    keys = tuple(f"ate_rot.{name}" for name in _NAMES)

    def evaluate(self, paired: Paired) -> MetricValues:
        """Needs the orientations of the ground truth."""
        if not paired.rotations_known:
            return absent(self.keys, paired.rotations_unknown)
        errors_rad = rotation_angles_rad(paired.matched_reference.quats_xyzw, paired.aligned.quats_xyzw)
        return MetricValues(statistics("ate_rot", np.rad2deg(errors_rad), _NAMES))


class RelativeSize:
    """ATE RMSE in percent of the true path, and of the error of an estimate that never moves."""

    keys = ("ate.per_path", "ate.per_extent")

    def evaluate(self, paired: Paired) -> MetricValues:
        """Missing if the ground truth does not move.

        Both are needed. In a room the error under Sim(3) never exceeds the extent, which is a few percent of a long
        path within four walls. On a road the extent is as large as the path.
        """
        truth = paired.matched_reference.positions_m
        error_m = _rms(paired.aligned.positions_m - truth)
        stamps_s = paired.matched_reference.stamps_s
        covered = (paired.reference.stamps_s >= stamps_s[0]) & (paired.reference.stamps_s <= stamps_s[-1])
        path_m = paired.reference.take(np.flatnonzero(covered)).path_length_m
        sizes_m = {"ate.per_path": path_m, "ate.per_extent": _rms(truth - truth.mean(axis=0))}
        values = {key: 100.0 * error_m / size_m for key, size_m in sizes_m.items() if size_m > 0}
        missing = {key: "the ground truth does not move" for key in self.keys if key not in values}
        return MetricValues(values, missing)


def _rms(vectors_m: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors_m**2, axis=1))))
