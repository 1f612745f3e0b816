"""Typed parameters of an algorithm: what a key means, what it may be, and parsing text into a typed value."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

from slamhive.base.errors import InvalidInput, lacks
from slamhive.domain.calibration import CameraIntrinsics, LidarLayout, camera_model, distortion_names, distortion_of
from slamhive.domain.names import plain
from slamhive.domain.sensors import CalibrationValue, Sensor, SensorKind, relative_pose

# Properties of sensors that a parameter can take its value from: the entry ``from`` of ``algorithm.yaml``.


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


Number = TypeVar("Number", int, float)
Scalar = int | float | str | bool
Value = Scalar | tuple[float, ...]
"""A parameter value. A matrix is a flat, row-major tuple of floats."""


class ParameterType(StrEnum):
    """The types that a parameter of ``algorithm.yaml`` can have."""

    INT = "int"
    FLOAT = "float"
    BOOL = "bool"
    STRING = "string"
    ENUM = "enum"
    MATRIX = "matrix"


_TRUE = {"1", "true", "yes", "on"}
_FALSE = {"0", "false", "no", "off"}
_LARGEST_INT = 2**63 - 1
_MAX_TEXT = 1024
_SHOWN = 200
_OUTDATED = "its definition in algorithm.yaml was edited; copy the configuration with a value that fits"


@dataclass(frozen=True, slots=True)
class Parameter:
    """The definition of one algorithm parameter.

    ``minimum`` and ``maximum`` are inclusive. ``general`` is the name under which the same thing is known across
    algorithms (``image_rate``, ``voxel_size``), so that different algorithms share an axis.

    ``source`` is the property of a sensor that gives the value unless the user does. ``default`` is then used if the
    dataset lacks the property; None if the value has to be known. With neither, each run has to give the value.
    """

    key: str
    type: ParameterType
    default: Value | None
    help: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    general: str | None = None
    source: SensorProperty | None = None

    @property
    def must_be_given(self) -> bool:
        """Nothing gives its value but the user: an import did not find its default."""
        return self.default is None and self.source is None

    def parse(self, raw: object) -> Value:
        """Turn text (CLI, form) or a YAML value into the typed value; raise InvalidInput naming key, value, remedy."""
        value = self._typed(raw)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, str | bool):
                continue
            too_small = self.minimum is not None and number < self.minimum
            too_large = self.maximum is not None and number > self.maximum
            if too_small or too_large:
                raise self._refuse(raw)
        return value

    @property
    def expectation(self) -> str:
        """Describe a legal value in words: ``int, 100 to 10000 features``."""
        if self.type is ParameterType.ENUM:
            return f"one of {', '.join(self.choices)}"
        if self.type is ParameterType.BOOL:
            return "true or false"
        bounds = ""
        if self.minimum is not None and self.maximum is not None:
            bounds = f", {plain(self.minimum)} to {plain(self.maximum)}"
        elif self.minimum is not None:
            bounds = f", at least {plain(self.minimum)}"
        elif self.maximum is not None:
            bounds = f", at most {plain(self.maximum)}"
        return f"{self.type}{bounds}{' ' + self.unit if self.unit else ''}"

    def _refuse(self, raw: object) -> InvalidInput:
        found = repr(raw)
        found = found if len(found) <= _SHOWN else f"{found[:_SHOWN]}..."
        return InvalidInput(f"parameter {self.key}={found} is not allowed", f"expected {self.expectation}")

    def _typed(self, raw: object) -> Value:
        if self.type is ParameterType.INT:
            return self._as_int(raw)
        if self.type is ParameterType.FLOAT:
            return self._as_float(raw)
        if self.type is ParameterType.MATRIX:
            parts = raw if isinstance(raw, list | tuple) else str(raw).strip().strip("[]").split(",")
            return tuple(self._as_float(part) for part in parts)
        text = str(raw)
        if self.type is ParameterType.BOOL:
            word = text.strip().lower()
            if word not in _TRUE and word not in _FALSE:
                raise self._refuse(raw)
            return word in _TRUE
        if self.type is ParameterType.ENUM:
            fits = text in self.choices
        else:
            fits = len(text) <= _MAX_TEXT and all(ord(character) >= 32 for character in text)
        if not fits:
            raise self._refuse(raw)
        return text

    def _as_int(self, raw: object) -> int:
        if isinstance(raw, float) and raw.is_integer():
            number = int(raw)
        elif isinstance(raw, int) and not isinstance(raw, bool):
            number = raw
        elif isinstance(raw, str):
            number = self._read(int, raw)
        else:
            raise self._refuse(raw)
        if abs(number) > _LARGEST_INT:
            raise self._refuse(raw)
        return number

    def _as_float(self, raw: object) -> float:
        if isinstance(raw, bool) or not isinstance(raw, int | float | str):
            raise self._refuse(raw)
        number = self._read(float, raw)
        if not math.isfinite(number):
            raise self._refuse(raw)
        return number

    def _read(self, kind: Callable[[str | float], Number], raw: str | float) -> Number:
        """``raw`` as a number; Python's own notations (``1_000``, digits of other scripts) are not what users mean."""
        if isinstance(raw, str) and ("_" in raw or not raw.isascii()):
            raise self._refuse(raw)
        try:
            return kind(raw)
        except (ValueError, OverflowError):
            raise self._refuse(raw) from None


def find_parameter(parameters: Sequence[Parameter], name: str) -> Parameter | None:
    """The parameter whose own key or general name is ``name``; the key wins."""
    for parameter in parameters:
        if parameter.key == name:
            return parameter
    return next((parameter for parameter in parameters if parameter.general == name), None)


def parse_settings(owner: str, parameters: tuple[Parameter, ...], settings: Mapping[str, object]) -> dict[str, Value]:
    """The values of ``owner``'s parameters: the defaults, overridden by ``settings``, in definition order.

    A parameter that takes its value from a sensor is left out unless it is set; an empty text does not set it. Settings
    are named by the own key or the general name of a parameter. Raises NotFound for an unknown name (with the nearest
    known one) and InvalidInput for a value that does not fit, or one parameter under both its names.
    """
    given: dict[str, tuple[str, object]] = {}
    for name, value in settings.items():
        parameter = find_parameter(parameters, name)
        if parameter is None:
            known = [entry.key for entry in parameters] + [entry.general for entry in parameters if entry.general]
            raise lacks(owner, "parameter", name, known)
        if parameter.key in given:
            raise InvalidInput(f"{given[parameter.key][0]} and {name} both set {parameter.key} of {owner}", "give one")
        given[parameter.key] = (name, value)
    values = default_values(parameters)
    for entry in parameters:
        # An empty text does not set what may be left out: a sensor gives it, or the check of the run asks for it.
        may_be_left_out = entry.source is not None or entry.must_be_given
        if entry.key in given and not (may_be_left_out and given[entry.key][1] == ""):
            values[entry.key] = entry.parse(given[entry.key][1])
    return {entry.key: values[entry.key] for entry in parameters if entry.key in values}


def default_values(parameters: Iterable[Parameter]) -> dict[str, Value]:
    """The defaults of parameters, without those that take their values from sensors."""
    return {entry.key: entry.default for entry in parameters if entry.source is None and entry.default is not None}


def check_stored(owner: str, parameters: Sequence[Parameter], values: Mapping[str, Value]) -> None:
    """Raise InvalidInput if stored ``values`` are no complete and legal set for ``owner`` as it is defined now.

    A definition may have been edited since the values were stored. They stay what they are: those that still fit are
    used as stored (a new default changes nothing), the first that does not is named.
    """
    known = {parameter.key: parameter for parameter in parameters}
    for key, value in values.items():
        if key not in known:
            raise InvalidInput(f"{owner} has no parameter {key!r} any more, {key}={value!r} is stored", _OUTDATED)
        parameter = known[key]
        try:
            fits = parameter.parse(value) == value and isinstance(value, bool) == (parameter.type is ParameterType.BOOL)
        except InvalidInput:
            fits = False
        if not fits:
            raise InvalidInput(
                f"{parameter.key}={value!r} is stored, {owner} now wants {parameter.expectation}", _OUTDATED
            )
    for key, parameter in known.items():
        if key not in values and parameter.source is None:
            raise InvalidInput(f"{owner} has a new parameter {key!r}, for which no value is stored", _OUTDATED)
