"""Rigid transforms, quaternions (w last) and rotation matrices, vectorised over poses.

scipy converts. Products and angles are computed here: scipy's take 17 to 75 times as long (``docs/design.md``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.trajectory.model import FloatArray, Poses, Trajectory

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


# How fast a body moves and turns along a trajectory.


WINDOW_S = 0.2
"""Mean motion over this time is shown: single steps of a 200 Hz ground truth are mostly noise."""

_LONGEST_WINDOWS = 5
"""Poses further apart than this many windows have a gap between them, where the motion is unknown."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Speed and angular rate over time.

    Attributes:
        times_s: The middle of each interval, shape (n,), on the clock of the trajectory.
        speeds_mps: Mean speed in each interval, shape (n,).
        angular_rates_radps: Mean angular rate in each interval, shape (n,).
    """

    times_s: FloatArray
    speeds_mps: FloatArray
    angular_rates_radps: FloatArray


def motion_of(poses: Poses, window_s: float = WINDOW_S) -> Motion:
    """The motion between each pose and the first one at least ``window_s`` later; nothing across gaps."""
    times_s = poses.stamps_s
    later = np.searchsorted(times_s, times_s + window_s)
    first = np.flatnonzero(later < len(times_s))
    last = later[first]
    close = times_s[last] - times_s[first] <= _LONGEST_WINDOWS * max(window_s, 1e-9)
    first, last = first[close], last[close]
    spans_s = times_s[last] - times_s[first]
    distances_m = np.linalg.norm(poses.positions_m[last] - poses.positions_m[first], axis=1)
    angles_rad = rotation_angles_rad(poses.quats_xyzw[first], poses.quats_xyzw[last])
    return Motion((times_s[first] + times_s[last]) / 2, distances_m / spans_s, angles_rad / spans_s)


# Interpolates poses: positions linearly, orientations along the shortest rotation (slerp).


_NEARLY_PARALLEL = 1 - 1e-9
"""Above this cosine slerp divides by almost 0, and linear interpolation is as good."""


def interpolate(trajectory: Trajectory, stamps_s: FloatArray) -> Poses:
    """The poses of ``trajectory`` at ``stamps_s``, shape (n,); before its start the first, after its end the last.

    Orientations by slerp (Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985). scipy's takes
    no equal timestamps, which a trajectory may hold.
    """
    if len(trajectory) == 1:
        alone = trajectory.take(np.zeros(len(stamps_s), dtype=np.intp))
        return Poses(stamps_s, alone.positions_m, alone.quats_xyzw)
    before = np.clip(np.searchsorted(trajectory.stamps_s, stamps_s, side="right") - 1, 0, len(trajectory) - 2)
    begin_s, end_s = trajectory.stamps_s[before], trajectory.stamps_s[before + 1]
    interval_s = np.where(end_s > begin_s, end_s - begin_s, 1.0)  # two poses at one time: the later one counts
    part = np.where(end_s > begin_s, np.clip((stamps_s - begin_s) / interval_s, 0.0, 1.0), 1.0)[:, None]
    positions_m = (1 - part) * trajectory.positions_m[before] + part * trajectory.positions_m[before + 1]
    begin_xyzw, end_xyzw = trajectory.quats_xyzw[before], trajectory.quats_xyzw[before + 1]
    cosine = (begin_xyzw * end_xyzw).sum(axis=1, keepdims=True)
    # A quaternion and its negative are one orientation: the nearer one gives the shorter way.
    end_xyzw = np.where(cosine < 0, -end_xyzw, end_xyzw)
    cosine = np.minimum(np.abs(cosine), 1.0)
    straight = cosine > _NEARLY_PARALLEL
    angle = np.arccos(np.where(straight, 0.0, cosine))
    sine = np.sin(angle)
    of_begin = np.where(straight, 1 - part, np.sin((1 - part) * angle) / sine)
    of_end = np.where(straight, part, np.sin(part * angle) / sine)
    quats_xyzw = of_begin * begin_xyzw + of_end * end_xyzw
    quats_xyzw /= np.linalg.norm(quats_xyzw, axis=1, keepdims=True)
    return Poses(stamps_s, positions_m, quats_xyzw)
