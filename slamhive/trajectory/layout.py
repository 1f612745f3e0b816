"""Poses as rows of numbers, before unit of times and order of quaternions are known.

TUM files hold seconds and x y z w; EuRoC's ground truth (Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR
2016) nanoseconds and w x y z; what programs write is any combination.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from slamhive.domain.protocol import Duplicates
from slamhive.trajectory.model import FloatArray, Poses, Trajectory
from slamhive.trajectory.orientation import lacking, no_rotations
from slamhive.trajectory.table import NumberTable, parse_table
from slamhive.trajectory.tum import checked

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
    """As :func:`parse_rows`, of a file with times and positions only."""
    table = parse_table(data, name, 4, "timestamp x y z")
    stated = Convention(stated_in(data).time_unit)
    quats = no_rotations(len(table.values))
    return RawPoses(table, table.values[:, 0], table.values[:, 1:4], quats, orientations=False, stated=stated)


_UNIT = re.compile(r"(?:time|stamp|^#\s*t)[a-z]*[\s_]*[\[(_]\s*(s|sec|ms|us|µs|ns)\b", re.IGNORECASE)
QUATERNION_NAME = re.compile(r"^(?:q|quat|quaternion|orientation|o)[a-z_.]*?[_.]?([xyzw])$", re.IGNORECASE)
_UNIT_NAMES = {unit.value: unit for unit in TimeUnit} | {"sec": TimeUnit.S, "µs": TimeUnit.US}
_ORDERS = {tuple(order.value): order for order in QuaternionOrder}


def stated_in(data: bytes) -> Convention:
    """What the comment lines at the top of a file say, such as ``#timestamp [ns], p_x [m], ..., q_w [], q_x []``."""
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
