"""Poses as rows of numbers, before unit of times and order of quaternions are known.

TUM files hold seconds and x y z w; EuRoC's ground truth (Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR
2016) nanoseconds and w x y z; what programs write is any combination.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from slamhive.base.files import write_aside
from slamhive.domain.protocol import Duplicates
from slamhive.trajectory.model import ZERO, FloatArray, Poses, Trajectory, find_problem, lacking, no_rotations, repair
from slamhive.trajectory.table import NumberTable, count_columns, parse_table, read_bounded

# The TUM trajectory format: ``timestamp tx ty tz qx qy qz qw``, seconds and metres, one pose a line.
#
# Published with the TUM RGB-D benchmark (Sturm et al., IROS 2012).


TUM_LAYOUT = "timestamp tx ty tz qx qy qz qw"
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
    table = parse_table(data, name, 8, TUM_LAYOUT)
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
    table = parse_table(data, name, 8, TUM_LAYOUT)
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
    stamps_s: FloatArray, positions_m: FloatArray, quats_xyzw: FloatArray, header: str | None = TUM_LAYOUT
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
    header: str | None = TUM_LAYOUT,
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


LAYOUT = "timestamp, x, y, z and four numbers of a quaternion"
_HEADER_LINES = 20


class TimeUnit(StrEnum):
    """The unit of the times of a file."""

    S = "s"
    MS = "ms"
    US = "us"
    NS = "ns"

    @property
    def per_second(self) -> float:
        """Number of units in a second."""
        return _PER_SECOND[self]


_PER_SECOND = {TimeUnit.S: 1.0, TimeUnit.MS: 1e3, TimeUnit.US: 1e6, TimeUnit.NS: 1e9}


class QuaternionOrder(StrEnum):
    """The order of the four numbers of a quaternion."""

    XYZW = "xyzw"
    WXYZ = "wxyz"


@dataclass(frozen=True, slots=True)
class Convention:
    """Unit and order; None where unknown."""

    time_unit: TimeUnit | None = None
    quaternion_order: QuaternionOrder | None = None


UNKNOWN = Convention()


@dataclass(frozen=True, slots=True, eq=False)
class RawPoses:
    """The poses of a file, as written.

    Attributes:
        table: Where they stood, for messages.
        times: In the unit of the file, shape (n,).
        positions_m: Shape (n, 3).
        quats: In the order of the file, shape (n, 4); where there are positions only, no rotation.
        orientations: The file holds orientations that mean something.
        without: Why those in the file mean nothing, empty if they do, or if there are none.
        stated: What the file's header says.
    """

    table: NumberTable
    times: FloatArray
    positions_m: FloatArray
    quats: FloatArray
    orientations: bool = True
    stated: Convention = UNKNOWN
    without: str = ""

    def trajectory(
        self, unit: TimeUnit, order: QuaternionOrder, duplicates: Duplicates = Duplicates.REFUSE
    ) -> Trajectory:
        """The poses in that unit and order; raises InvalidInput naming line and value."""
        quats_xyzw = np.roll(self.quats, -1, axis=1) if order is QuaternionOrder.WXYZ else self.quats
        return checked(self.table, Poses(self.times / unit.per_second, self.positions_m, quats_xyzw), duplicates)


def parse_rows(data: bytes, name: str, *, more_columns: bool = False) -> RawPoses:
    """The poses in the bytes of a text file that messages call ``name``; four columns are time and position.

    ``more_columns``: what stands behind the quaternion is left out. Quaternions that are no orientations become no
    rotation. Raises InvalidInput naming line and value.
    """
    table = parse_table(data, name, 8, LAYOUT, more_columns=more_columns)
    times, positions_m, quats = table.values[:, 0], table.values[:, 1:4], table.values[:, 4:8]
    without = lacking(quats, positions_m)
    if without:
        quats = no_rotations(len(quats))
    return RawPoses(table, times, positions_m, quats, not without, stated_in(data), without)


def parse_position_rows(data: bytes, name: str) -> RawPoses:
    """The same as :func:`parse_rows`, of a file with times and positions only."""
    table = parse_table(data, name, 4, "timestamp x y z")
    stated = Convention(stated_in(data).time_unit)
    quats = no_rotations(len(table.values))
    return RawPoses(table, table.values[:, 0], table.values[:, 1:4], quats, orientations=False, stated=stated)


_UNIT = re.compile(r"(?:time|stamp|^#\s*t)[a-z]*[\s_]*[\[(_]\s*(s|sec|ms|us|µs|ns)\b", re.IGNORECASE)
QUATERNION_NAME = re.compile(r"^(?:q|quat|quaternion|orientation|o)[a-z_.]*?[_.]?([xyzw])$", re.IGNORECASE)
_UNIT_NAMES = {unit.value: unit for unit in TimeUnit} | {"sec": TimeUnit.S, "µs": TimeUnit.US}
_ORDERS = {tuple(order.value): order for order in QuaternionOrder}


def stated_in(data: bytes) -> Convention:
    """Read the comment lines at the top of a file, such as ``#timestamp [ns], p_x [m], ..., q_w [], q_x []``."""
    unit: TimeUnit | None = None
    order: QuaternionOrder | None = None
    for line in data.splitlines()[:_HEADER_LINES]:
        text = line.decode("utf-8", errors="replace").strip()
        if text and not text.startswith("#"):
            break
        found = _UNIT.search(text)
        unit = _UNIT_NAMES[found[1].lower()] if found is not None else unit
        words = (QUATERNION_NAME.match(word) for word in re.split(r"[\s,;#\[\]()]+", text))
        order = _ORDERS.get(tuple(word[1].lower() for word in words if word is not None), order)
    return Convention(unit, order)
