"""The layout of a LiDAR's points, recognised from the fields that each maker's driver writes, and their numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import LidarLayout
from slamhive.recordings.writers import NS_PER_S
from slamhive.runtime.messages import Array, stamp_ns, to_points
from slamhive.runtime.point_times import PointTimes, SweepInstant, TimeReference, TimeUnit


@dataclass(frozen=True, slots=True)
class Driver:
    """The times that a driver writes for points.

    Attributes:
        makers: Whose LiDARs, or which programs.
        field: The name of the field.
        kind: Its type, as numpy calls it.
        unit: The unit of the times.
        reference: What they count from.
    """

    makers: str
    field: str
    kind: str
    unit: TimeUnit
    reference: TimeReference


DRIVERS = (
    Driver("Velodyne, Unitree, LSLidar", "time", "f4", TimeUnit.S, TimeReference.TIMESTAMP),
    Driver("LSLidar", "time", "f8", TimeUnit.S, TimeReference.TIMESTAMP),
    Driver("Ouster", "t", "u4", TimeUnit.NS, TimeReference.TIMESTAMP),
    Driver("Livox", "offset_time", "u4", TimeUnit.NS, TimeReference.TIMESTAMP),
    Driver("Hesai, RoboSense, Seyond", "timestamp", "f8", TimeUnit.S, TimeReference.ABSOLUTE),
    Driver("Livox", "timestamp", "f8", TimeUnit.NS, TimeReference.ABSOLUTE),
    Driver("Autoware", "time_stamp", "f8", TimeUnit.S, TimeReference.ABSOLUTE),
    Driver("Autoware", "time_stamp", "u4", TimeUnit.NS, TimeReference.TIMESTAMP),
    Driver("Aeva", "time_offset_ns", "i4", TimeUnit.NS, TimeReference.TIMESTAMP),
    Driver("Blickfeld", "point_time_offset", "u4", TimeUnit.NS, TimeReference.TIMESTAMP),
)
"""Drivers by the name and type of the field. What the numbers show counts where they show another unit or zero."""
_MORE_FIELDS = ("timestamps", "time_offset", "timeOffset", "offset_t", "rel_time", "point_time", "stamp")
"""Fields of converters and of programs without a driver here, recognised by their numbers alone."""
_RINGS = ("ring", "line", "channel", "laser_id", "line_index", "layer")
_NEAR_S = 1.0
"""Times of points that count from the header's clock lie at most so far from the message's timestamp."""
_SHORTEST_SPREAD, _LONGEST_SPREAD = 0.1, 2.0
"""The parts of a sweep that its times cover: at least, and at most."""


def layout_of(message: Any, rate_hz: float) -> tuple[LidarLayout, str]:
    """Find the layout that one ``PointCloud2`` shows, and a note for the user; raises InvalidInput if it is damaged.

    Args:
        message: The first one of the topic.
        rate_hz: The rate of the sweeps.
    """
    cloud = to_points(message)
    ring = next((name for name in _RINGS if name in cloud.fields), "")
    organised = int(message.height) > 1
    rings = cloud.fields.get(ring, np.empty(0))
    beams = int(message.height) if organised else int(rings.max()) + 1 if rings.size else None
    times, note = _times(cloud.fields, stamp_ns(message) / NS_PER_S, 1.0 / rate_hz)
    return LidarLayout(times, ring, organised=organised, beams=beams), note


def _times(fields: dict[str, Array], stamp_s: float, duration_s: float) -> tuple[PointTimes, str]:
    """Times of the points, by the first field that says so, and a note for the user."""
    names = [driver.field for driver in DRIVERS if driver.field in fields]
    problems = []
    for field in dict.fromkeys([*names, *(name for name in _MORE_FIELDS if name in fields)]):
        values = fields[field].astype(np.float64)
        known = [driver for driver in DRIVERS if driver.field == field and driver.kind == fields[field].dtype.str[1:]]
        found = _read_as(values, known, stamp_s, duration_s)
        if isinstance(found, str):
            problems.append(f"field {field} {found}")
            continue
        driver, offsets_s = found
        # The points before and after the timestamp tell which instant of the sweep it is.
        instant = SweepInstant.START
        # A shorter spread is that of one column only.
        if offsets_s.size and np.ptp(offsets_s) >= _SHORTEST_SPREAD * duration_s:
            middle = float(offsets_s.min() + offsets_s.max()) / 2
            if middle < -0.25 * duration_s:
                instant = SweepInstant.END
            elif abs(middle) < 0.25 * duration_s:
                instant = SweepInstant.MIDDLE
        times = PointTimes(duration_s, field, driver.unit, driver.reference, instant)
        maker = f" ({driver.makers})" if driver.makers else ""
        return times, (
            f"the time of a point is its field {field}{maker}, {driver.unit} from {_ZEROS[driver.reference]}; "
            f"timestamps mean the {times.stamp} of a sweep"
        )
    if problems:
        return PointTimes(duration_s), f"the times of points are not used: {'; '.join(problems)}"
    return PointTimes(duration_s), f"points have no time that is known (fields {', '.join(('x', 'y', 'z', *fields))})"


def _read_as(values: Array, known: list[Driver], stamp_s: float, duration_s: float) -> tuple[Driver, Array] | str:
    """The driver whose times ``values`` are, with their offsets from the timestamp in s; or why they are no times.

    A driver without makers is what the numbers show where no driver fits.
    """
    if not np.isfinite(values).all():
        return "holds numbers that are not finite"
    if len(values) > 1 and np.ptp(values) == 0:
        return f"is {values[0]:.12g} for all points"
    by_numbers = [
        Driver("", "", "", unit, reference)
        for unit in TimeUnit
        for reference in (TimeReference.TIMESTAMP, TimeReference.ABSOLUTE)
    ]
    # what a known driver wrote of a part of a sweep comes last: in a larger unit it may be all of it
    for driver, least_s in (
        *((driver, _SHORTEST_SPREAD * duration_s) for driver in (*known, *by_numbers)),
        *((driver, 0.0) for driver in known),
    ):
        zero_s = stamp_s if driver.reference is TimeReference.ABSOLUTE else 0.0
        offsets_s = values * driver.unit.seconds - zero_s
        if _fits(offsets_s, driver.reference, least_s, duration_s):
            return driver, offsets_s
    if known:
        unit, zero = known[0].unit, known[0].reference
        apart_s = values[0] * unit.seconds - (stamp_s if zero is TimeReference.ABSOLUTE else 0.0)
        return f"is {apart_s:.3f} s from the message's timestamp, read in {unit} from {_ZEROS[zero]}"
    return f"counts from {values.min():.6g} to {values.max():.6g}, which is no part of a sweep of {duration_s:g} s"


def _fits(offsets_s: Array, reference: TimeReference, least_s: float, duration_s: float) -> bool:
    """Return whether points with these offsets cover ``least_s`` of one sweep near its timestamp."""
    if not offsets_s.size:
        return least_s == 0
    spread_s, furthest_s = float(np.ptp(offsets_s)), float(np.abs(offsets_s).max())
    near_s = _NEAR_S if reference is TimeReference.ABSOLUTE else _LONGEST_SPREAD * duration_s
    return furthest_s <= near_s and least_s <= spread_s <= _LONGEST_SPREAD * duration_s


_ZEROS = {
    TimeReference.TIMESTAMP: "the message's timestamp",
    TimeReference.ABSOLUTE: "the zero of the clock",
    TimeReference.SWEEP_START: "the start of the sweep",
}


# Livox's ``CustomMsg`` as ``PointCloud2``.
#
# A recording with it is converted, so that the player, the pre-processing steps and all algorithms read one type of
# point cloud. Decoding each point as an object would also be too slow for playback: a scan has 20,000 of them.


POINT = np.dtype(
    [
        ("offset_time", "<u4"),
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("reflectivity", "u1"),
        ("tag", "u1"),
        ("line", "u1"),
    ]
)
"""A ``CustomPoint`` as ROS 1 packs it; in ROS 2 a byte of padding follows all but the last one."""
_CDR_ITEM_BYTES = 20


def livox_layout(rate_hz: float) -> tuple[LidarLayout, str]:
    """The layout of the point clouds that :func:`livox_points` makes, and a note for the user."""
    times = PointTimes(1.0 / rate_hz, "offset_time", TimeUnit.NS, TimeReference.TIMESTAMP)
    return LidarLayout(times, "line"), "Livox points become PointCloud2, the time of a point is offset_time in ns"


def livox_points(raw: bytes, *, cdr: bool) -> tuple[int, int, Array]:
    """The timestamp of the header, the time from which points count (both in ns), and the points (n,) of a message.

    Args:
        raw: The serialised ``CustomMsg``.
        cdr: As ROS 2 serialises it, otherwise as ROS 1 does.

    Raises InvalidInput if the bytes are no such message.
    """
    reader = _Reader(raw, cdr=cdr)
    if not cdr:
        reader.take("<u4")  # the header's sequence number
    seconds, nanoseconds = reader.take("<u4"), reader.take("<u4")
    reader.skip(reader.take("<u4"))  # the frame
    timebase_ns = reader.take("<u8")
    reader.take("<u4")  # the number of points
    reader.skip(4)  # the LiDAR's number, reserved bytes
    count = reader.take("<u4")
    stamp_ns = int(seconds) * 1_000_000_000 + int(nanoseconds)
    return stamp_ns, timebase_ns, reader.points(count)


class _Reader:
    def __init__(self, raw: bytes, *, cdr: bool) -> None:
        self._raw = raw[4:] if cdr else raw  # CDR begins with four bytes about itself
        self._cdr = cdr
        self._place = 0

    def take(self, kind: str) -> int:
        """The next number, aligned as CDR asks."""
        size = np.dtype(kind).itemsize
        if self._cdr:
            self._place += -self._place % size
        value = self._raw[self._place : self._place + size]
        if len(value) < size:
            raise self._short()
        self._place += size
        return int.from_bytes(value, "little")

    def skip(self, count: int) -> None:
        self._place += count

    def points(self, count: int) -> Array:
        item_bytes = _CDR_ITEM_BYTES if self._cdr else POINT.itemsize
        rest = self._raw[self._place :]
        if count * item_bytes > len(rest) + (item_bytes - POINT.itemsize):
            raise self._short()
        if item_bytes == POINT.itemsize:
            return np.frombuffer(rest, POINT, count)
        padded = np.frombuffer(rest[: count * item_bytes].ljust(count * item_bytes, b"\0"), f"V{item_bytes}")
        return np.ascontiguousarray(padded.view(np.uint8).reshape(count, item_bytes)[:, : POINT.itemsize]).view(POINT)[
            :, 0
        ]

    def _short(self) -> InvalidInput:
        return InvalidInput(f"a Livox CustomMsg of {len(self._raw)} bytes ends early", "the recording may be damaged")
