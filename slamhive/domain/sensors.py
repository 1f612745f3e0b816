"""Sensors of a dataset, and what kind of sensing an algorithm does with them."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

Matrix4 = tuple[float, ...]
"""A 4x4 homogeneous transform as 16 floats, row-major."""

IDENTITY4: Matrix4 = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)

CalibrationValue = float | int | str | tuple[float, ...]
"""What a key of a sensor's calibration may hold; ``bool`` is an ``int``."""

_RIGID_TOLERANCE = 1e-3


def is_rigid(transform: Matrix4) -> bool:
    """Tell if ``transform`` is a rotation (orthonormal within 1e-3, no reflection) and a translation, all finite."""
    if len(transform) != len(IDENTITY4) or not all(math.isfinite(number) for number in transform):
        return False
    rows = [transform[start : start + 3] for start in (0, 4, 8)]
    dots = [(sum(map(operator.mul, a, b)), float(a is b)) for a in rows for b in rows]
    (a, b, c), (d, e, f), (g, h, i) = rows
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    return (
        all(abs(found - wanted) <= _RIGID_TOLERANCE for found, wanted in dots)
        and determinant > 0
        and tuple(transform[12:]) == IDENTITY4[12:]
    )


class SensorKind(StrEnum):
    """The kinds of sensor a dataset can hold."""

    CAMERA = "camera"
    DEPTH = "depth"
    IMU = "imu"
    LIDAR = "lidar"
    LASER = "laser"
    """A laser scanner that measures in one plane."""
    ODOMETRY = "odometry"
    """Wheel odometry: poses and velocities that the platform computes itself."""
    GNSS = "gnss"


class SensorSetup(StrEnum):
    """Sensors that an algorithm uses; they decide which alignment its trajectory deserves."""

    MONO = "mono"
    STEREO = "stereo"
    RGBD = "rgbd"
    MONO_INERTIAL = "mono-inertial"
    STEREO_INERTIAL = "stereo-inertial"
    LIDAR = "lidar"
    LIDAR_INERTIAL = "lidar-inertial"
    LASER = "laser"
    """A laser scanner in one plane, with or without wheel odometry."""


def setups_of(counts: Mapping[SensorKind, int]) -> tuple[SensorSetup, ...]:
    """The set-ups that a recording can serve.

    Args:
        counts: The number of sensors of each kind.
    """
    cameras, inertial = counts.get(SensorKind.CAMERA, 0), counts.get(SensorKind.IMU, 0) > 0
    served = {
        SensorSetup.MONO: cameras > 0,
        SensorSetup.STEREO: cameras > 1,
        SensorSetup.RGBD: cameras > 0 and counts.get(SensorKind.DEPTH, 0) > 0,
        SensorSetup.MONO_INERTIAL: cameras > 0 and inertial,
        SensorSetup.STEREO_INERTIAL: cameras > 1 and inertial,
        SensorSetup.LIDAR: counts.get(SensorKind.LIDAR, 0) > 0,
        SensorSetup.LIDAR_INERTIAL: counts.get(SensorKind.LIDAR, 0) > 0 and inertial,
        SensorSetup.LASER: counts.get(SensorKind.LASER, 0) > 0,
    }
    return tuple(setup for setup in SensorSetup if served[setup])


@dataclass(frozen=True, slots=True)
class Sensor:
    """One sensor of a dataset and the topic its messages are recorded on.

    ``T_body_sensor`` maps points in the sensor frame to the body frame (metres). ``calibration`` holds the
    numbers that only this kind of sensor has, under the keys documented in ``docs/dataset-format.md``
    (``width``, ``fx``, ``gyroscope_noise_density`` ...).
    """

    name: str
    kind: SensorKind
    topic: str
    rate_hz: float
    T_body_sensor: Matrix4 = IDENTITY4
    calibration: dict[str, CalibrationValue] = field(default_factory=dict)


def relative_pose(sensor: Sensor, other: Sensor) -> Matrix4:
    """``T_sensor_other``: maps points in the frame of ``other`` to that of ``sensor``, by rows, in m."""
    to, of = sensor.T_body_sensor, other.T_body_sensor
    moved = [of[row * 4 + 3] - to[row * 4 + 3] for row in range(3)]
    rows: list[float] = []
    for axis in range(3):
        column = [to[row * 4 + axis] for row in range(3)]
        turned = [sum(column[row] * of[row * 4 + place] for row in range(3)) for place in range(3)]
        rows += [*turned, sum(map(operator.mul, column, moved))]
    return (*rows, 0.0, 0.0, 0.0, 1.0)
