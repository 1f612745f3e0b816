"""Rigid transforms, quaternions (w last) and rotation matrices, vectorised over poses.

scipy converts. Products and angles are computed here: scipy's take 17 to 75 times as long (``docs/design.md``).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamhive.errors import InvalidInput
from slamhive.trajectory.model import FloatArray, Trajectory

_RIGID_TOLERANCE = 1e-4


def rotations_from_quats(quats_xyzw: FloatArray) -> FloatArray:
    """Rotation matrices, shape (n, 3, 3), of unit quaternions, shape (n, 4)."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - 0.3 s, which only those who need it should pay

    return np.asarray(Rotation.from_quat(quats_xyzw).as_matrix())


def quats_from_rotations(rotations: FloatArray) -> FloatArray:
    """Unit quaternions, shape (n, 4), of rotation matrices, shape (n, 3, 3)."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - as above

    return np.asarray(Rotation.from_matrix(rotations, assume_valid=True).as_quat())


def multiply_quats(left_xyzw: FloatArray, right_xyzw: FloatArray) -> FloatArray:
    """The quaternions of the rotations ``left`` after ``right``; shapes (n, 4), or (1, 4) for all."""
    ax, ay, az, aw = left_xyzw.T
    bx, by, bz, bw = right_xyzw.T
    return np.column_stack(
        (
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        )
    )


def inverse_quats(quats_xyzw: FloatArray) -> FloatArray:
    """The quaternions of the inverse rotations, shape (n, 4)."""
    return np.asarray(quats_xyzw * np.array([-1.0, -1.0, -1.0, 1.0]))


def rotation_angles_rad(first_xyzw: FloatArray, second_xyzw: FloatArray) -> FloatArray:
    """Angle of the rotation from each of ``first`` to each of ``second``, unit quaternions (n, 4); shape (n,), 0 to pi.

    2 atan2(|v|, |w|) of the quaternion between them, which is exact for small angles as acos is not.
    """
    between = multiply_quats(inverse_quats(first_xyzw), second_xyzw)
    angles: FloatArray = 2.0 * np.arctan2(np.linalg.norm(between[:, :3], axis=1), np.abs(between[:, 3]))
    return angles


def rigid_transform(numbers: Sequence[float], name: str) -> FloatArray:
    """The 4x4 transform in 16 row-major ``numbers``; raises InvalidInput, calling it ``name``, if it is not rigid."""
    matrix = np.asarray(numbers, dtype=np.float64)
    if matrix.size != 16 or not np.isfinite(matrix).all():
        raise InvalidInput(f"{name} must be 16 finite numbers, got {matrix.size}", "write a 4x4 matrix row by row")
    matrix = matrix.reshape(4, 4)
    rotation = matrix[:3, :3]
    orthogonal = np.abs(rotation @ rotation.T - np.eye(3)).max() < _RIGID_TOLERANCE
    if not orthogonal or np.linalg.det(rotation) < 0 or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise InvalidInput(f"{name} is not a rotation with a translation", "check the extrinsics of the dataset")
    return matrix


def move_sensor(trajectory: Trajectory, T_body_sensor: FloatArray) -> Trajectory:
    """The trajectory of a sensor from that of the body it is mounted on: T_world_sensor = T_world_body T_body_sensor.

    Args:
        trajectory: Poses of the body.
        T_body_sensor: Shape (4, 4), pose of the sensor in the body frame.
    """
    rotations = rotations_from_quats(trajectory.quats_xyzw)
    positions_m = trajectory.positions_m + rotations @ T_body_sensor[:3, 3]
    quats_xyzw = quats_from_rotations(rotations @ T_body_sensor[:3, :3])
    return Trajectory(trajectory.stamps_s, positions_m, quats_xyzw)
