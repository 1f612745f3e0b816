"""Trajectories without timestamps, one pose a frame, as the evaluation takes them."""

from __future__ import annotations

import numpy as np

from slamhive.trajectory.model import FloatArray
from slamhive.trajectory.transforms import quats_from_rotations
from slamhive.trajectory.tum import format_tum

FRAME_S = 0.1
"""Poses are matched by index, so any interval will do; the scanner of KITTI turns ten times a second."""


def frame_trajectory(matrices: FloatArray) -> bytes:
    """The text of a TUM file of poses, shape (n, 4, 4), that are equally spaced in time."""
    stamps_s = FRAME_S * np.arange(len(matrices), dtype=np.float64)
    return format_tum(stamps_s, matrices[:, :3, 3], quats_from_rotations(matrices[:, :3, :3])).encode()
