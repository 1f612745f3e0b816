"""Livox's ``CustomMsg`` as ``PointCloud2``.

A recording with it is converted, so that the player, the pre-processing steps and all algorithms read one type of
point cloud. Decoding each point as an object would also be too slow for playback: a scan has 20,000 of them.
"""

from __future__ import annotations

import numpy as np

from slamhive.bags.geometry import Array
from slamhive.domain.lidar_layout import LidarLayout
from slamhive.errors import InvalidInput
from slamhive.runtime.point_times import PointTimes, TimeReference, TimeUnit

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
