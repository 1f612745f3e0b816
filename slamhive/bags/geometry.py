"""Rotations and rigid transforms as numpy arrays; quaternions are x, y, z, w."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """Unit quaternions (n, 4) of rotations (n, 3, 3), the sign chosen so that neighbours never flip.

    The largest of the four candidates is used, which is stable for every rotation (Shepperd 1978).
    """
    trace = R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2]
    squares = np.stack(
        [
            1 + 2 * R[:, 0, 0] - trace,
            1 + 2 * R[:, 1, 1] - trace,
            1 + 2 * R[:, 2, 2] - trace,
            1 + trace,
        ],
        axis=1,
    )
    quats = np.empty((len(R), 4))
    for index, largest in enumerate(np.argmax(squares, axis=1)):
        quats[index] = _quaternion_row(R[index], int(largest))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return _continuous(quats)


def _quaternion_row(R: Array, largest: int) -> Array:
    symmetric = R + R.T
    skew = (R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    row = np.empty(4)
    if largest == 3:
        row[:3] = skew
        row[3] = 1 + R[0, 0] + R[1, 1] + R[2, 2]
    else:
        row[:3] = symmetric[largest]
        row[largest] = 1 + 2 * R[largest, largest] - (R[0, 0] + R[1, 1] + R[2, 2])
        row[3] = skew[largest]
    return row


def _continuous(quats: Array) -> Array:
    if quats[0, 3] < 0:
        quats[0] *= -1
    dots = np.sum(quats[1:] * quats[:-1], axis=1)
    signs = np.cumprod(np.where(dots < 0, -1.0, 1.0))
    quats[1:] *= signs[:, None]
    return quats
