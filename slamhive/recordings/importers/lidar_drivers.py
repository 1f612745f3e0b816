"""The layout of a LiDAR's points, recognised from the fields that each maker's driver writes."""

from __future__ import annotations

from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import LidarLayout
from slamhive.recordings.geometry import Array
from slamhive.recordings.ros1_writer import NS_PER_S
from slamhive.runtime.messages import stamp_ns, to_points
from slamhive.runtime.point_times import PointTimes, SweepInstant, TimeReference, TimeUnit

_TIMES: dict[tuple[str, str], tuple[TimeUnit, TimeReference]] = {
    ("time", "f4"): (TimeUnit.S, TimeReference.TIMESTAMP),  # Velodyne
    ("t", "u4"): (TimeUnit.NS, TimeReference.TIMESTAMP),  # Ouster
    ("offset_time", "u4"): (TimeUnit.NS, TimeReference.TIMESTAMP),  # Livox
    ("timestamp", "f8"): (TimeUnit.S, TimeReference.ABSOLUTE),  # Hesai, RoboSense
    ("time_stamp", "f8"): (TimeUnit.S, TimeReference.ABSOLUTE),
}
"""The unit and the zero of each field of times, by its name and numpy type."""
_RINGS = ("ring", "line")
_NEAR_S = 1.0
"""Times of points that count from the header's clock lie at most so far from the message's timestamp."""


_SHORTEST_SPREAD = 0.1
"""The part of a sweep that its times cover at least."""


def layout_of(message: Any, rate_hz: float) -> tuple[LidarLayout, str]:
    """What one ``PointCloud2`` shows of the layout, and a note for the user; raises InvalidInput if it is damaged.

    Args:
        message: The first one of the topic.
        rate_hz: The rate of the sweeps.
    """
    cloud = to_points(message)
    ring = next((name for name in _RINGS if name in cloud.fields), "")
    organised = int(message.height) > 1
    rings = cloud.fields.get(ring, np.empty(0))
    beams = int(message.height) if organised else int(rings.max()) + 1 if rings.size else None
    duration_s = 1.0 / rate_hz
    names = [name for name, kind in _TIMES if name in cloud.fields and cloud.fields[name].dtype.str[1:] == kind]
    if not names:
        times = PointTimes(duration_s)
        note = f"points have no time that is known (fields {', '.join(('x', 'y', 'z', *cloud.fields))})"
        return LidarLayout(times, ring, organised=organised, beams=beams), note
    field = names[0]
    unit, reference = _TIMES[field, cloud.fields[field].dtype.str[1:]]
    offsets_s = cloud.fields[field].astype(np.float64) * unit.seconds
    if reference is TimeReference.ABSOLUTE:
        offsets_s -= stamp_ns(message) / NS_PER_S
        if offsets_s.size and np.abs(offsets_s).max() > _NEAR_S:
            words = f"the times of points in field {field} are {offsets_s[0]:.3f} s from the message's timestamp"
            return LidarLayout(PointTimes(duration_s), ring, organised=organised, beams=beams), f"{words}: not used"
    times = PointTimes(duration_s, field, unit, reference, _instant(offsets_s, duration_s))
    note = (
        f"the time of a point is its field {field}, {unit} from {_ZEROS[reference]}; timestamps mean the {times.stamp}"
    )
    return LidarLayout(times, ring, organised=organised, beams=beams), f"{note} of a sweep"


_ZEROS = {
    TimeReference.TIMESTAMP: "the message's timestamp",
    TimeReference.ABSOLUTE: "the zero of the clock",
    TimeReference.SWEEP_START: "the start of the sweep",
}


def _instant(offsets_s: Any, duration_s: float) -> SweepInstant:
    """Which instant of the sweep the timestamp is, by the points before and after it."""
    if not offsets_s.size or np.ptp(offsets_s) < _SHORTEST_SPREAD * duration_s:
        return SweepInstant.START  # one column, or times that are not filled in
    middle = float(offsets_s.min() + offsets_s.max()) / 2
    if middle < -0.25 * duration_s:
        return SweepInstant.END
    return SweepInstant.MIDDLE if abs(middle) < 0.25 * duration_s else SweepInstant.START


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
