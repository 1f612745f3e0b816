"""Writes MRPT's ``.rawlog``: observations one after the other, in MRPT's binary serialisation.

MRPT's own converter of logs cannot be used: ``carmen2rawlog`` 2.5.8 gives all observations the same time. An object is
the length of its class name with the highest bit set, the name, a version, the content, and a byte that ends it.
The versions of the classes are those that MRPT 2.5.8 writes itself.
"""

from __future__ import annotations

import struct
from typing import BinaryIO

import numpy as np

from slamhive.runtime.messages import LaserScan

_END = b"\x88"
_UNIX_EPOCH_IN_S_SINCE_1601 = 11_644_473_600
_TICKS_PER_S = 10_000_000
_BEAM_APERTURE_RAD = 0.0044
_RANGE_SIGMA_M = 0.01


class RawlogWriter:
    """Writes observations in order of time.

    Args:
        stream: The file.
        T_body_laser: (4, 4) pose of the laser in the frame of the odometry.
        maximum_range_m: Of the laser.
    """

    def __init__(self, stream: BinaryIO, T_body_laser: np.ndarray, maximum_range_m: float) -> None:
        self._stream = stream
        self._T_body_laser = T_body_laser
        self._maximum_range_m = maximum_range_m

    def odometry(self, stamp_s: float, x_m: float, y_m: float, yaw_rad: float) -> None:
        """The pose of the wheels' odometry."""
        pose = _object("mrpt::poses::CPose2D", 1, struct.pack("<3d", x_m, y_m, yaw_rad))
        content = pose + _text("ODOMETRY") + _time(stamp_s) + struct.pack("<??", False, False)
        self._stream.write(_object("mrpt::obs::CObservationOdometry", 2, content))

    def scan(self, stamp_s: float, scan: LaserScan) -> None:
        """One scan. MRPT's scans are symmetric to the x axis, so the pose of the sensor is turned to their middle."""
        first_rad, last_rad = float(scan.angles_rad[0]), float(scan.angles_rad[-1])
        T = self._T_body_laser @ _turned((first_rad + last_rad) / 2)
        pose = struct.pack("<12d", *T[:3, 3], *T[:3, :3].ravel())
        measured = np.isfinite(scan.ranges_m)
        ranges_m = np.where(measured, scan.ranges_m, self._maximum_range_m)
        content = (
            struct.pack("<f?f", abs(last_rad - first_rad), last_rad >= first_rad, self._maximum_range_m)
            + _object("mrpt::poses::CPose3D", 3, pose)
            + struct.pack("<I", len(ranges_m))
            + ranges_m.astype("<f4").tobytes()
            + measured.astype("u1").tobytes()
            + struct.pack("<f", _RANGE_SIGMA_M)
            + _time(stamp_s)
            + struct.pack("<f", _BEAM_APERTURE_RAD)
            + _text("LASER")
            + struct.pack("<d?", 0.0, False)
        )
        self._stream.write(_object("mrpt::obs::CObservation2DRangeScan", 7, content))


def _object(name: str, version: int, content: bytes) -> bytes:
    return bytes([0x80 | len(name)]) + name.encode("ascii") + bytes([version]) + content + _END


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode("ascii")


def _time(stamp_s: float) -> bytes:
    """A time in units of 100 ns since 1601."""
    return struct.pack("<Q", round((stamp_s + _UNIX_EPOCH_IN_S_SINCE_1601) * _TICKS_PER_S))


def _turned(yaw_rad: float) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]]
    return T
