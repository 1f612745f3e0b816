"""Columns of a row that hold the pose: by their names, by the user's words, or by how many there are.

Systems write more than a TUM file holds: covariances, velocities, an index. The names of columns are the best evidence.
Without names, a count is taken for the layout of a system only if the numbers fit it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.trajectory.formats import systems_by_columns
from slamhive.trajectory.layout import (
    QUATERNION_NAME,
    Convention,
    QuaternionOrder,
    RawPoses,
    stated_in,
)
from slamhive.trajectory.model import QUATERNION_TOLERANCE
from slamhive.trajectory.orientation import lacking, no_rotations
from slamhive.trajectory.table import count_columns, parse_table
from slamhive.trajectory.transforms import quats_from_rotations

SYSTEMS = systems_by_columns()
"""Systems that write rows of so many columns, for messages."""
_MATRIX_COLUMNS, _WHOLE_MATRIX_COLUMNS, _POSE_COLUMNS = 13, 17, 8
_TIME = re.compile(r"^(?:t|sec|u?time.*|gpstime|stamp.*)$", re.IGNORECASE)
_POSITION = re.compile(
    r"^(?:t|p|pos|position|trans|translation|p_\w*|(?:\w+\.)*(?:position|translation))?[_.]?([xyz])$", re.IGNORECASE
)
_UNITS = re.compile(r"[\[(][^\])]*[\])]")
_ORTHOGONAL = 1e-2


@dataclass(frozen=True, slots=True)
class Columns:
    """Where a row of ``count`` columns holds the pose, from 0.

    Attributes:
        count: How many columns a row has.
        time: That of the timestamp.
        position: Those of x, y and z.
        orientation: Four of a quaternion, nine of a matrix by rows, or none.
        order: Of the quaternion; None if nothing says it.
    """

    count: int
    time: int
    position: tuple[int, ...]
    orientation: tuple[int, ...]
    order: QuaternionOrder | None = None


def with_header_as_comment(data: bytes) -> bytes:
    """The bytes with ``#`` before a first line that names columns, as spreadsheets and OKVIS2 write it."""
    lines = data.removeprefix(b"\xef\xbb\xbf").split(b"\n")
    first = next((index for index, line in enumerate(lines) if line.strip()), None)
    if first is None or lines[first].lstrip().startswith(b"#"):
        return data
    names = _names(lines[first].decode("utf-8", errors="replace"))
    if _by_names(names) is None:
        return data
    lines[first] = b"#" + lines[first]
    return b"\n".join(lines)


def find_columns(data: bytes) -> Columns | None:
    """Where the rows hold the pose, if anything but a plain layout shows it; None for the plain ones and in doubt."""
    count = count_columns(data)
    for line in _comments(data):
        names = _names(line)
        found = _by_names(names) if len(names) == count else None
        if found is not None:
            return found
    return _by_count(data, count)


def stated_columns(text: str, count: int) -> Columns:
    """The columns that a user names, such as ``t,x,y,z,qw,qx,qy,qz``; ``-`` is one that is left out.

    Raises InvalidInput.
    """
    names = [word.strip() for word in text.split(",")]
    remedy = "write for instance t,x,y,z,qw,qx,qy,qz, with - for columns that are left out"
    found = _by_names(names)
    if found is None or len(names) > count:
        problem = f"names {len(names)} of {count} columns" if found is not None else "lacks t, x, y, z, or a part of q"
        raise InvalidInput(f"--columns {text[:80]!r} {problem}", remedy)
    return Columns(count, found.time, found.position, found.orientation, found.order)


def parse_columns(data: bytes, name: str, columns: Columns) -> RawPoses:
    """The poses in those columns; raises InvalidInput naming line and value."""
    system = f", as of {SYSTEMS[columns.count]}" if columns.count in SYSTEMS else ""
    table = parse_table(data, name, columns.count, f"{columns.count} columns{system}")
    values = table.values
    stated = Convention(stated_in(data).time_unit, columns.order)
    times, positions_m = values[:, columns.time], values[:, list(columns.position)]
    if not columns.orientation:
        return RawPoses(table, times, positions_m, no_rotations(len(values)), orientations=False, stated=stated)
    quats = values[:, list(columns.orientation)]
    if len(columns.orientation) > 4:
        quats = quats_from_rotations(quats.reshape(-1, 3, 3))
    without = lacking(quats, positions_m)
    quats = no_rotations(len(values)) if without else quats
    return RawPoses(table, times, positions_m, quats, not without, stated, without)


def _comments(data: bytes) -> list[str]:
    """The comment lines above the first row."""
    found: list[str] = []
    for line in data.splitlines():
        text = line.decode("utf-8", errors="replace").strip()
        if text and not text.startswith("#"):
            break
        found.append(text)
    return found


def _names(line: str) -> list[str]:
    """The names of columns in a line, without units: ``# p_RS_R_x [m], ...``."""
    text = _UNITS.sub("", line.lstrip("\ufeff# \t"))
    words = text.split(",") if "," in text else text.split()
    return [word.strip() for word in words if word.strip() and not word.strip().endswith(":")]


def _by_names(names: list[str]) -> Columns | None:
    """The columns with these names, None if a part of the pose is not among them."""
    time = next((place for place, name in enumerate(names) if _TIME.match(name)), None)
    axes: dict[str, int] = {}
    quats: dict[str, int] = {}
    for place, name in enumerate(names):
        quat, position = QUATERNION_NAME.match(name), _POSITION.match(name)
        if quat is not None:
            quats.setdefault(quat[1].lower(), place)
        elif position is not None:
            axes.setdefault(position[1].lower(), place)
    if time is None or len(axes) != len("xyz") or len(quats) not in {0, 4}:
        return None
    position_places = tuple(axes[axis] for axis in "xyz")
    # They are read in the order x y z w wherever they stand.
    orientation = tuple(quats[axis] for axis in "xyzw") if quats else ()
    return Columns(len(names), time, position_places, orientation, QuaternionOrder.XYZW if quats else None)


def _by_count(data: bytes, count: int) -> Columns | None:
    """The layout of a system that writes so many columns without names, if the numbers fit."""
    if count not in SYSTEMS or count <= _POSE_COLUMNS:
        return None
    try:
        values = parse_table(data, "", count, "").values
    except InvalidInput:
        return None
    whole = count == _WHOLE_MATRIX_COLUMNS and (values[:, 13:] == [0, 0, 0, 1]).all()
    if count == _MATRIX_COLUMNS or whole:
        places = (1, 2, 3, 5, 6, 7, 9, 10, 11)
        R = values[:, list(places)].reshape(-1, 3, 3)
        with np.errstate(over="ignore", invalid="ignore"):
            fits = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < _ORTHOGONAL and (np.linalg.det(R) > 0).all()
        return Columns(count, 0, (4, 8, 12), places, QuaternionOrder.XYZW) if fits else None
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.linalg.norm(values[:, 4:8], axis=1) - 1)
    return Columns(count, 0, (1, 2, 3), (4, 5, 6, 7)) if (off <= QUATERNION_TOLERANCE).all() else None
