"""Absolute rotation error: the angle between matched orientations."""

from __future__ import annotations

import numpy as np

from slamhive.evaluation.evaluators.base import ROTATIONS_UNKNOWN, Figures, Paired, absent
from slamhive.evaluation.evaluators.pairs import statistics
from slamhive.trajectory.transforms import rotation_angles_rad

_NAMES = ("rmse", "mean", "median", "max")


class RotationError:
    """ATE, rotation part: evo's APE with ``angle_deg``."""

    keys = tuple(f"ate_rot.{name}" for name in _NAMES)

    def evaluate(self, paired: Paired) -> Figures:
        """Needs the orientations of the ground truth."""
        if not paired.rotations_known:
            return absent(self.keys, ROTATIONS_UNKNOWN)
        errors_rad = rotation_angles_rad(paired.matched_reference.quats_xyzw, paired.aligned.quats_xyzw)
        return Figures(statistics("ate_rot", np.rad2deg(errors_rad), _NAMES))
