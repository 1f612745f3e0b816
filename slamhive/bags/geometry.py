"""Rotations and rigid transforms as numpy arrays; quaternions are x, y, z, w."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamhive.runtime.trajectory import quaternions_xyzw

Array = NDArray[Any]


def rotation_xyz(roll_rad: Array | float, pitch_rad: Array | float, yaw_rad: Array | float) -> Array:
    """``Rz(yaw) Ry(pitch) Rx(roll)`` for scalars or arrays of shape (n,); returns (..., 3, 3)."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows, dtype=np.float64), (0, 1), (-2, -1))


def transform(R: Array, t: Array | list[float]) -> Array:
    """The 4x4 transform with rotation ``R`` (3, 3) and translation ``t`` (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def quaternions_from_rotations(R: Array) -> Array:
    """Unit quaternions (n, 4) of rotations (n, 3, 3), the sign chosen so that neighbours never flip."""
    quats = quaternions_xyzw(R)
    dots = np.sum(quats[1:] * quats[:-1], axis=1)
    quats[1:] *= np.cumprod(np.where(dots < 0, -1.0, 1.0))[:, None]
    return quats
