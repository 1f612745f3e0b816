"""Writes ``traj.txt`` in TUM format, complete or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamhive.base.errors import InvalidInput
from slamhive.base.files import write_aside
from slamhive.runtime.paths import TRAJECTORY_FILES

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Poses:
    """An estimated trajectory.

    Attributes:
        stamps_s: (n,) seconds, the recording's own time.
        T_world_sensor: (n, 4, 4) poses of the sensor in the algorithm's world frame, metres.
    """

    stamps_s: Array
    T_world_sensor: Array


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Several trajectories of one run.

    Attributes:
        main: What ``algorithm.yaml`` calls the trajectory of the mode.
        others: Further ones, by kind: ``live``, ``final`` or ``keyframes``.
    """

    main: Poses
    others: Mapping[str, Poses]


def write_trajectories(folder: Path, found: Poses | Trajectories) -> Poses:
    """Write ``traj.txt`` and the others, if they hold poses; returns the main one. Raises InvalidInput."""
    main, others = (found, {}) if isinstance(found, Poses) else (found.main, found.others)
    for kind, poses in others.items():
        if len(poses.stamps_s):
            write_trajectory(folder / TRAJECTORY_FILES[kind], poses)
    write_trajectory(folder / "traj.txt", main)
    return main


def write_trajectory(path: Path, poses: Poses) -> None:
    """Write ``poses`` in order of time; raises InvalidInput for NaN or matrices that are no rigid motion."""
    stamps_s = np.asarray(poses.stamps_s, dtype=np.float64).reshape(-1)
    T = np.asarray(poses.T_world_sensor, dtype=np.float64).reshape(-1, 4, 4)
    if len(stamps_s) != len(T):
        raise InvalidInput(f"{len(stamps_s)} timestamps for {len(T)} poses")
    if not (np.isfinite(stamps_s).all() and np.isfinite(T).all()):
        raise InvalidInput("the estimated trajectory holds a value that is not a number")
    rotations = nearest_rotations(T[:, :3, :3])
    rows = np.column_stack((stamps_s, T[:, :3, 3], quaternions_xyzw(rotations)))
    rows = rows[np.argsort(stamps_s, kind="stable")]
    text = "# timestamp tx ty tz qx qy qz qw\n" + "".join(
        " ".join(f"{value:.9f}" for value in row) + "\n" for row in rows.tolist()
    )
    write_aside(path, text)


def read_poses(text: str) -> Poses:
    """The poses of ``text`` in TUM format, as a program of the run wrote it. Raises InvalidInput for other text."""
    try:
        rows = np.array([line.split() for line in text.splitlines() if not line.startswith("#")], dtype=np.float64)
        rows = rows.reshape(-1, 8)
    except ValueError:
        raise InvalidInput("the trajectory that the algorithm saved is not in TUM format") from None
    return poses_of_rows(rows[:, 0], rows[:, 1:])


def poses_of_rows(stamps_s: Array, rows: Array) -> Poses:
    """The poses in ``rows`` (n, 7): position, then a quaternion with w last, in any scale. Raises InvalidInput."""
    rows = np.asarray(rows, dtype=np.float64).reshape(-1, 7)
    if len(rows) != len(stamps_s):
        raise InvalidInput(f"the algorithm gave {len(rows)} poses for {len(stamps_s)} images")
    poses = np.array([transform_from(row[:3], row[3:]) for row in rows]).reshape(-1, 4, 4)
    return Poses(np.asarray(stamps_s, dtype=np.float64), poses)


def nearest_rotations(matrices: Array) -> Array:
    """The rotations nearest to (n, 3, 3) ``matrices``, by singular value decomposition (rounding taken out).

    Raises InvalidInput for a matrix that is further than rounding from any rotation.
    """
    U, _, Vt = np.linalg.svd(matrices)
    rotations: Array = U @ Vt
    off = np.abs(rotations - matrices).max(axis=(1, 2), initial=0.0)
    if len(off) and (off.max() > 1e-3 or np.linalg.det(rotations).min() < 0):
        raise InvalidInput(f"pose {int(off.argmax())} of the estimate is not a rigid motion")
    return rotations


def quaternions_xyzw(R: Array) -> Array:
    """Unit quaternions (n, 4), w last and not negative, of rotations (n, 3, 3).

    The largest of the four squared components is taken from the diagonal first (Shepperd 1978), which never divides
    by a small number.
    """
    diagonal = np.einsum("nii->ni", R)
    trace = diagonal.sum(axis=1, keepdims=True)
    squares = np.hstack([1 + 2 * diagonal - trace, 1 + trace]) / 4
    largest = squares.argmax(axis=1)
    products = np.empty((len(R), 4, 4))
    products[:, range(4), range(4)] = squares
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        products[:, i, j] = products[:, j, i] = (R[:, i, j] + R[:, j, i]) / 4
        products[:, k, 3] = products[:, 3, k] = (R[:, j, i] - R[:, i, j]) / 4
    quats = products[np.arange(len(R)), largest]
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    signed: Array = np.where(quats[:, 3:] < 0, -quats, quats)
    return signed


def transform_from(position_m: Array, quat_xyzw: Array) -> Array:
    """The 4x4 transform of a position (3,) and a quaternion (4,), w last."""
    x, y, z, w = np.asarray(quat_xyzw, dtype=np.float64) / np.linalg.norm(quat_xyzw)
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = position_m
    return T
