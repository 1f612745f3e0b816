"""The TUM trajectory format: ``timestamp tx ty tz qx qy qz qw``, seconds and metres, one pose a line.

Published with the TUM RGB-D benchmark (Sturm et al., IROS 2012).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamhive.domain.protocol import Duplicates
from slamhive.files import write_aside
from slamhive.trajectory.duplicates import repair
from slamhive.trajectory.model import FloatArray, Poses, Trajectory, find_problem
from slamhive.trajectory.orientation import ZERO, lacking, no_rotations
from slamhive.trajectory.table import NumberTable, count_columns, parse_table, read_bounded

LAYOUT = "timestamp tx ty tz qx qy qz qw"
POSITIONS_LAYOUT = "timestamp tx ty tz"
POSITIONS_ONLY = "the file holds positions only"
_ROW = " ".join(["%.9f"] * 8) + "\n"


def read_tum(path: Path) -> Trajectory:
    """Read the trajectory at ``path``.

    Raises:
        NotFound: There is no such file.
        InvalidInput: It is not a valid trajectory; the message names file, line and value.
    """
    return parse_tum(read_bounded(path), str(path))


def parse_tum(data: bytes, name: str, duplicates: Duplicates = Duplicates.REFUSE) -> Trajectory:
    """The trajectory in the bytes of a TUM file that messages call ``name``; raises InvalidInput.

    ``duplicates``: what is done with poses that have the same timestamp.
    """
    table = parse_table(data, name, 8, LAYOUT)
    return checked(table, Poses(table.values[:, 0], table.values[:, 1:4], table.values[:, 4:8]), duplicates)


def parse_positions(data: bytes, name: str, duplicates: Duplicates = Duplicates.REFUSE) -> Trajectory:
    """A trajectory of timestamps and positions from a receiver or a total station; orientations have no meaning.

    Raises InvalidInput.
    """
    table = parse_table(data, name, 4, POSITIONS_LAYOUT)
    quats_xyzw = no_rotations(len(table.values))
    return checked(table, Poses(table.values[:, 0], table.values[:, 1:4], quats_xyzw), duplicates)


def parse_ground_truth(data: bytes, name: str, duplicates: Duplicates = Duplicates.REFUSE) -> tuple[Trajectory, str]:
    """The ground truth in the bytes of a TUM file, or of one of timestamps and positions; raises InvalidInput.

    Returns:
        The trajectory, and why its orientations mean nothing; empty if they do.
    """
    if count_columns(data) == len(POSITIONS_LAYOUT.split()):
        return parse_positions(data, name, duplicates), POSITIONS_ONLY
    table = parse_table(data, name, 8, LAYOUT)
    quats, positions_m = table.values[:, 4:8], table.values[:, 1:4]
    without = lacking(quats, positions_m)
    # What never changes is checked all the same: it has to be quaternions.
    quats = no_rotations(len(quats)) if without == ZERO else quats
    return checked(table, Poses(table.values[:, 0], positions_m, quats), duplicates), without


def checked(table: NumberTable, poses: Poses, duplicates: Duplicates) -> Trajectory:
    """The trajectory in the rows of ``table``; raises InvalidInput that names the line."""
    allowed = duplicates is not Duplicates.REFUSE
    problem = find_problem(poses.stamps_s, poses.positions_m, poses.quats_xyzw, duplicates=allowed)
    if problem is not None:
        raise table.error(problem.index, problem.found, problem.remedy)
    return repair(poses, duplicates)


def format_tum(
    stamps_s: FloatArray, positions_m: FloatArray, quats_xyzw: FloatArray, header: str | None = LAYOUT
) -> str:
    """The text of a TUM file with 9 decimals; ``header`` becomes comment lines, None for none."""
    rows = np.column_stack((stamps_s, positions_m, quats_xyzw))
    comment = "" if header is None else "".join(f"# {line}\n" for line in header.splitlines())
    return comment + (_ROW * len(rows)) % tuple(rows.ravel().tolist())


def write_tum(
    path: Path,
    stamps_s: FloatArray,
    positions_m: FloatArray,
    quats_xyzw: FloatArray,
    header: str | None = LAYOUT,
) -> None:
    """Write a TUM file in one step: a reader sees the old file or the new one. Raises Unavailable.

    Args:
        path: Where to; an existing file is replaced.
        stamps_s: Seconds, shape (n,).
        positions_m: Shape (n, 3).
        quats_xyzw: Unit quaternions, w last, shape (n, 4).
        header: Text for the comment lines at the top, None for none.
    """
    write_aside(path, format_tum(stamps_s, positions_m, quats_xyzw, header))
