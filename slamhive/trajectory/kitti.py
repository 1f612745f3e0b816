"""KITTI odometry poses: the upper 3x4 of T_world_camera, 12 numbers row by row, one pose a line; timestamps apart.

Format: Geiger et al., "Are we ready for autonomous driving?", CVPR 2012.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import write_aside
from slamhive.trajectory.layout import Convention, QuaternionOrder, RawPoses, TimeUnit, stated_in
from slamhive.trajectory.model import FloatArray, Trajectory
from slamhive.trajectory.table import IntArray, NumberTable, parse_table, read_bounded
from slamhive.trajectory.transforms import quats_from_rotations, rotations_from_quats

LAYOUT = "12 numbers: r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"
_ORTHOGONAL_TOLERANCE = 1e-2


def read_kitti(poses_path: Path, times_path: Path) -> Trajectory:
    """Read poses and their timestamps (one number a line, s).

    Raises:
        NotFound: One of the files does not exist.
        InvalidInput: One of them is malformed, or they differ in their number of lines; the message names file, line
            and value.
    """
    return read_kitti_rows(poses_path, times_path).trajectory(TimeUnit.S, QuaternionOrder.XYZW)


def read_kitti_rows(poses_path: Path, times_path: Path) -> RawPoses:
    """The same as :func:`read_kitti`, before it is known in which unit the timestamps are."""
    poses, matrices = _parse_poses(read_bounded(poses_path), str(poses_path))
    times = parse_table(read_bounded(times_path), str(times_path), 1, "timestamp")
    if poses.places[-1] != times.places[-1]:
        raise InvalidInput(
            f"{poses_path} has {_counted(poses, 'poses')}, {times_path} has {_counted(times, 'timestamps')}",
            "both need one line per frame",
        )
    kept, stamps, unit = pair_with_times(str(poses_path), poses.places, times_path, "KITTI")
    R, positions_m = matrices[kept][:, :, :3], matrices[kept][:, :, 3]
    stated = Convention(unit, QuaternionOrder.XYZW)
    return RawPoses(stamps, stamps.values[:, 0], positions_m, quats_from_rotations(R), stated=stated)


def pair_with_times(
    name: str, places: IntArray, times_path: Path | None, system: str
) -> tuple[IntArray, NumberTable, TimeUnit | None]:
    """Give poses the timestamps of their places.

    Args:
        name: What messages call the file of the poses.
        places: The number of each pose, from 0: its line in the file of the timestamps.
        times_path: That file, with one number a line.
        system: Who writes such poses, for messages.

    Returns:
        The poses that have a timestamp, the rows of those timestamps, and their unit if the file states it.

    Raises:
        NotFound: There is no such file.
        InvalidInput: There is none given, it is malformed, or has fewer lines than there are poses.
    """
    if times_path is None:
        raise InvalidInput(
            f"{name} holds poses as {system} writes them, which have no timestamps",
            "give a TUM file; imports of runs also take the file of the timestamps (--times)",
        )
    data = read_bounded(times_path)
    times = parse_table(data, str(times_path), 1, "timestamp")
    if int(places.max()) > int(times.places[-1]):
        raise InvalidInput(
            f"{name} has a pose of frame {int(places.max())}, {times_path} has {_counted(times, 'timestamps')}",
            "line n, from 0, has to be the timestamp of frame n",
        )
    _, of_poses, of_times = np.intersect1d(places, times.places, return_indices=True)
    if not len(of_poses):
        raise InvalidInput(f"{name} and {times_path} have no line in common", "both need one line per frame")
    return of_poses, times.take(of_times), stated_in(data).time_unit


def read_kitti_matrices(path: Path) -> FloatArray:
    """The poses as the file has them, shape (n, 4, 4): not made orthonormal. Raises as :func:`read_kitti`."""
    return parse_kitti_matrices(read_bounded(path), str(path))


def parse_kitti_matrices(data: bytes, name: str) -> FloatArray:
    """The poses in the bytes of a KITTI file that messages call ``name``, shape (n, 4, 4); raises InvalidInput."""
    table, rows = _parse_poses(data, name)
    blank = np.flatnonzero(table.places != np.arange(len(rows)))
    if len(blank):
        row = int(blank[0])
        raise InvalidInput(
            f"{name}: a line before line {table.line_number(row)} is blank",
            "each line is a frame and has no timestamp: write the pose of every frame",
        )
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3] = rows
    return matrices


def _counted(table: NumberTable, rows: str) -> str:
    blank = int(table.places[-1]) + 1 - len(table.values)
    return f"{len(table.values)} {rows}" + (f" and {blank} blank lines" if blank else "")


def _parse_poses(data: bytes, name: str) -> tuple[NumberTable, FloatArray]:
    """The rows of the file, and the upper 3x4 of every pose, shape (n, 3, 4)."""
    table = parse_table(data, name, 12, LAYOUT)
    finite = np.isfinite(table.values).all(axis=1)
    if not finite.all():
        raise table.error(int((~finite).argmax()), "a number is not finite", "leave out frames that are not known")
    matrices = table.values.reshape(-1, 3, 4)
    rotations = matrices[:, :, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        wrong = ~(errors < _ORTHOGONAL_TOLERANCE) | (np.linalg.det(rotations) < 0)
    if wrong.any():
        raise table.error(
            int(wrong.argmax()), "the 3x3 part is not a rotation", "write orthonormal matrices of determinant 1"
        )
    return table, matrices


def format_kitti(positions_m: FloatArray, quats_xyzw: FloatArray) -> str:
    """The text of a KITTI pose file; shapes (n, 3) and (n, 4)."""
    matrices = np.concatenate((rotations_from_quats(quats_xyzw), positions_m[:, :, None]), axis=2)
    row = " ".join(["%.12e"] * 12) + "\n"
    return (row * len(matrices)) % tuple(matrices.ravel().tolist())


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write the poses of ``trajectory``, without its timestamps, in one step. Raises Unavailable."""
    write_aside(path, format_kitti(trajectory.positions_m, trajectory.quats_xyzw))
