"""Poses and laser scans in a plane: streams of 2D laser scanners and of wheel odometry."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from slamhive.bags.bag_writer import BagWriter
from slamhive.bags.geometry import Array
from slamhive.bags.importing import Stream
from slamhive.bags.text_lines import Track
from slamhive.domain.sensors import Matrix4, Sensor
from slamhive.errors import InvalidInput

_ODOMETRY_BYTES = 750
_SCAN_BYTES = 150


def pose_quats_xyzw(yaws_rad: Array) -> Array:
    """Unit quaternions (n, 4) of rotations by ``yaws_rad`` (n,) around z."""
    zeros = np.zeros(len(yaws_rad))
    return np.stack([zeros, zeros, np.sin(yaws_rad / 2), np.cos(yaws_rad / 2)], axis=1)


def planar_transform(x_m: float, y_m: float, yaw_rad: float, z_m: float = 0.0) -> Matrix4:
    """A transform that turns around z only."""
    c, s = float(np.cos(yaw_rad)), float(np.sin(yaw_rad))
    return (c, -s, 0.0, x_m, s, c, 0.0, y_m, 0.0, 0.0, 1.0, z_m, 0.0, 0.0, 0.0, 1.0)


def odometry_stream(sensor: Sensor, times_ns: Array, poses: Array, twists: Array | None = None) -> Stream:
    """The messages of planar odometry.

    Args:
        sensor: The wheels.
        times_ns: Int64 (n,).
        poses: x, y in m and yaw in rad, (n, 3).
        twists: Forward velocity in m/s and yaw rate in rad/s, (n, 2); None if they are not known.
    """
    quats_xyzw = pose_quats_xyzw(poses[:, 2])

    def write(bag: BagWriter, index: int) -> None:
        pose = np.concatenate([poses[index, :2], [0.0], quats_xyzw[index]])
        twist = np.zeros(6)
        if twists is not None:
            twist[[0, 5]] = twists[index]
        bag.odometry(sensor, int(times_ns[index]), pose, twist)

    return Stream(sensor, times_ns, write, _ODOMETRY_BYTES)


def laser_stream(sensor: Sensor, track: Track, scans: Callable[[], Iterator[Array]], count: int) -> Stream:
    """The messages of a laser scanner whose file is read a second time while the recording is written.

    Scans that stand before earlier ones wait in memory, so memory grows with how late scans are, not with the file.

    Args:
        sensor: The scanner.
        track: The times of all scans of the file.
        scans: Starts reading the ranges (``count``,) in m of all scans of the file.
        count: Ranges of a scan.
    """
    times_ns, kept = track.times_ns, track.kept.tolist()
    wanted = frozenset(kept)
    reading: list[Iterator[tuple[int, Array]]] = []
    waiting: dict[int, Array] = {}

    def write(bag: BagWriter, index: int) -> None:
        if index == 0:
            reading[:] = [enumerate(scans())]
            waiting.clear()
        while kept[index] not in waiting:
            number, ranges_m = next(reading[0], (-1, None))
            if ranges_m is None:
                break
            if number in wanted:
                waiting[number] = ranges_m
        ranges_m = waiting.pop(kept[index], None)
        if ranges_m is None or len(ranges_m) != count:
            raise InvalidInput(f"scan {index} of {sensor.name} changed while it was imported", "import again")
        bag.laser_scan(sensor, int(times_ns[index]), ranges_m)

    return Stream(sensor, times_ns, write, _SCAN_BYTES + 4 * count)
