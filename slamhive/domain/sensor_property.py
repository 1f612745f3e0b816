"""Properties of sensors that a parameter can take its value from: the entry ``from`` of ``algorithm.yaml``."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from slamhive.domain.calibration import CameraIntrinsics, camera_model, distortion_names, distortion_of
from slamhive.domain.lidar_layout import LidarLayout
from slamhive.domain.sensors import CalibrationValue, Sensor, SensorKind, relative_pose
from slamhive.errors import InvalidInput

_FORM = re.compile(r"([^.()\s]+)\.([A-Za-z_]\w*)(?:\(([^.()\s]+)\))?")
_REMEDY = "write ROLE.PROPERTY, for instance left.fx, or ROLE.PROPERTY(OTHER ROLE), for instance left.bf(right)"
_CAMERAS = {SensorKind.CAMERA, SensorKind.DEPTH}


@dataclass(frozen=True, slots=True)
class SensorProperty:
    """A property of the sensor in a role, or of two sensors together.

    ``left.fx`` is a calibration key or one of :data:`DERIVED`; ``left.bf(right)`` is one of :data:`OF_TWO`.
    """

    role: str
    name: str
    other: str | None = None

    @classmethod
    def parse(cls, text: str) -> SensorProperty:
        """Read ``left.fx`` or ``left.bf(right)``; raises InvalidInput."""
        match = _FORM.fullmatch(text)
        if match is None:
            raise InvalidInput(f"{text!r} names no property of a sensor", _REMEDY)
        found = cls(match[1], match[2], match[3])
        if (found.name in OF_TWO) is (found.other is None):
            known = ", ".join(OF_TWO)
            raise InvalidInput(f"{text!r} is not clear: only {known} are properties of two sensors", _REMEDY)
        return found

    def __str__(self) -> str:
        return f"{self.role}.{self.name}" + (f"({self.other})" if self.other else "")

    @property
    def roles(self) -> tuple[str, ...]:
        """The roles that it concerns."""
        return (self.role,) if self.other is None else (self.role, self.other)

    def value(self, sensors: Mapping[str, Sensor]) -> CalibrationValue | None:
        """The value for the sensors by role; None if it is not known. Raises InvalidInput for a bad calibration."""
        sensor = sensors[self.role]
        if self.other is not None:
            return OF_TWO[self.name](sensor, sensors[self.other])
        found = sensor.calibration.get(self.name)
        if found is None and self.name in DERIVED:
            found = DERIVED[self.name](sensor)
        elif found is None and sensor.kind in _CAMERAS:
            found = _distortion(sensor).get(self.name)
        elif found is None and sensor.kind is SensorKind.LIDAR:
            found = LidarLayout.of(sensor).calibration().get(self.name)
        return None if found == "" else found


def _camera_matrix(sensor: Sensor) -> CalibrationValue | None:
    if sensor.kind not in _CAMERAS:
        return None
    camera = CameraIntrinsics.of(sensor)
    return (camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0)


def _distortion(sensor: Sensor) -> dict[str, float]:
    """The coefficients by name; those that a model leaves out are 0."""
    camera = CameraIntrinsics.of(sensor)
    names = distortion_names(camera.model)
    values = (*camera.distortion, *(0.0 for _ in names))
    return dict(zip(names, values, strict=False))


def _angle(choose: Callable[[tuple[float, ...]], float]) -> Callable[[Sensor], float | None]:
    def find(sensor: Sensor) -> float | None:
        angles = LidarLayout.of(sensor).vertical_angles_deg if sensor.kind is SensorKind.LIDAR else ()
        return choose(angles) if angles else None

    return find


def _between_rings(angles_deg: tuple[float, ...]) -> float:
    return (max(angles_deg) - min(angles_deg)) / max(len(angles_deg) - 1, 1)


DERIVED: dict[str, Callable[[Sensor], CalibrationValue | None]] = {
    "name": lambda sensor: sensor.name,
    "topic": lambda sensor: sensor.topic,
    "rate_hz": lambda sensor: sensor.rate_hz,
    "T_body_sensor": lambda sensor: sensor.T_body_sensor,
    "model": lambda sensor: camera_model(sensor.calibration, sensor.name).value if sensor.kind in _CAMERAS else None,
    "camera_matrix": _camera_matrix,
    "distortion": lambda sensor: distortion_of(sensor.calibration) if sensor.kind in _CAMERAS else None,
    "lowest_angle_deg": _angle(min),
    "highest_angle_deg": _angle(max),
    "ring_distance_deg": _angle(_between_rings),
}
"""Properties that are no calibration keys, or that have a value without one."""


def _baseline_m(sensor: Sensor, other: Sensor) -> float:
    return math.hypot(*relative_pose(sensor, other)[3:12:4])


def _bf(sensor: Sensor, other: Sensor) -> float | None:
    fx = sensor.calibration.get("fx")
    return float(fx) * _baseline_m(sensor, other) if isinstance(fx, int | float) else None


OF_TWO: dict[str, Callable[[Sensor, Sensor], CalibrationValue | None]] = {
    "T": relative_pose,
    "baseline_m": _baseline_m,
    "bf": _bf,
}
"""Properties of two sensors: the pose of the other in the frame of the first, their distance, and that times fx."""
