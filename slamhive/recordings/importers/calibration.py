"""Calibration that is known before messages are read: from files (also of other tools), and from topics."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import COEFFICIENTS, TIME_OFFSET, CameraIntrinsics, CameraModel, ImuNoise
from slamhive.domain.sensors import CalibrationValue, Matrix4, SensorKind, is_rigid
from slamhive.packages.dataset_file import load_sensors
from slamhive.recordings.geometry import Array, transform
from slamhive.recordings.text_lists import read_lines
from slamhive.trajectory.transforms import rotations_from_quats


@dataclass(frozen=True)
class CalibrationFile:
    """A mapping of a calibration file, or a part of one.

    Attributes:
        name: What messages call it: the path, and the place inside it.
        content: Its keys.
    """

    name: str
    content: dict[str, Any]

    def part(self, key: str) -> CalibrationFile:
        """The mapping under ``key``; raises InvalidInput."""
        value = self._value(key)
        if not isinstance(value, dict):
            raise InvalidInput(f"{self.name}: {key} is no mapping", "correct the file")
        return CalibrationFile(f"{self.name}: {key}", value)

    def parts(self, key: str) -> list[CalibrationFile]:
        """The mappings in the list under ``key``, none without the key; raises InvalidInput."""
        value = self.content.get(key) or []
        if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
            raise InvalidInput(f"{self.name}: {key} is no list of mappings", "correct the file")
        return [CalibrationFile(f"{self.name}: {key} {index}", entry) for index, entry in enumerate(value)]

    def number(self, key: str) -> float:
        """A finite number; raises InvalidInput."""
        return self.numbers(key, 1)[0]

    def positive(self, key: str) -> float:
        """A finite number above 0; raises InvalidInput."""
        value = self.number(key)
        if value <= 0:
            raise InvalidInput(f"{self.name}: {key} is {value:g}", "expected a number above 0")
        return value

    def optional(self, key: str) -> float | None:
        """A finite number, None without the key; raises InvalidInput."""
        return self.number(key) if key in self.content else None

    def numbers(self, key: str, *counts: int) -> tuple[float, ...]:
        """Read as many finite numbers as one of ``counts`` says, from a list, an OpenCV matrix or a single number.

        Raises InvalidInput.
        """
        value = self._value(key)
        if isinstance(value, dict):
            value = value.get("data")
        try:
            found = np.array(value, dtype=np.float64).reshape(-1)
        except (TypeError, ValueError, OverflowError):
            raise InvalidInput(f"{self.name}: {key} is {str(value)[:60]!r}, no numbers", "correct the file") from None
        allowed = " or ".join(str(count) for count in counts)
        if (counts and len(found) not in counts) or not np.isfinite(found).all():
            raise InvalidInput(f"{self.name}: {key} has {len(found)} numbers", f"expected {allowed} finite numbers")
        return tuple(float(number) for number in found)

    def size(self, *keys: str) -> tuple[int, int]:
        """Width and height in pixels, under one key as a list or under two; raises InvalidInput."""
        found = [number for key in keys for number in self.numbers(key, 1, 2)]
        if len(found) != 2 or not all(number == int(number) and 0 < number < 100_000 for number in found):
            raise InvalidInput(f"{self.name}: {' and '.join(keys)} is no width and height: {found}", "correct the file")
        return int(found[0]), int(found[1])

    def word(self, key: str, default: str | None = None) -> str:
        """A text; raises InvalidInput without the key, unless there is a default."""
        return str(self._value(key) if default is None else self.content.get(key, default))

    def rigid(self, key: str) -> Array:
        """A rigid transform (4, 4); raises InvalidInput."""
        numbers: Matrix4 = self.numbers(key, 16)
        if not is_rigid(numbers):
            raise InvalidInput(
                f"{self.name}: {key} is no rigid transform", "expected a rotation and a translation in m"
            )
        return np.array(numbers).reshape(4, 4)

    def _value(self, key: str) -> Any:
        if self.content.get(key) is None:
            raise InvalidInput(f"{self.name} lacks {key}", "add it from the calibration of the dataset")
        return self.content[key]


def read_calibration_file(path: Path) -> CalibrationFile:
    """Read a YAML file, also one with OpenCV's ``%YAML:1.0`` and ``!!opencv-matrix``, which YAML does not allow.

    Raises InvalidInput.
    """
    lines = [line.replace("!!opencv-matrix", "") for line in read_lines(path) if not line.startswith("%YAML:")]
    return CalibrationFile(str(path), strict_yaml.parse("\n".join(lines), str(path)))


# Calibration that is known before messages are read: from files and from topics.


@dataclass(frozen=True, eq=False)
class KnownSensor:
    """One sensor of a calibration.

    Attributes:
        name: What the calibration calls it.
        kind: What it measures.
        topic: Where its messages are, empty if the calibration does not say.
        frame: What transforms call it; several files may have a ``cam0``.
        intrinsics: Of a camera.
        noise: Of an IMU.
        more: Further keys of ``dataset.yaml``.
    """

    name: str
    kind: SensorKind
    topic: str
    frame: str
    intrinsics: CameraIntrinsics | None = None
    noise: ImuNoise | None = None
    more: dict[str, CalibrationValue] = field(default_factory=dict)


@dataclass(eq=False)
class KnownCalibration:
    """Sensors, and transforms ``(parent, child, T_parent_child)`` between their frames; ``body`` is the body frame.

    ``notes`` say what was not read.
    """

    sensors: list[KnownSensor] = field(default_factory=list)
    transforms: list[tuple[str, str, Array]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


# Where frames are relative to each other: rigid transforms between pairs of them, joined along the shortest path.


class FrameGraph:
    """Frames by name, and the transforms between them that are known."""

    def __init__(self) -> None:
        self._neighbours: dict[str, dict[str, Array]] = {}

    def add(self, parent: str, child: str, T_parent_child: Array) -> None:
        """Add ``T_parent_child`` (4, 4); the first one that is known of a pair counts."""
        if child not in self._neighbours.get(parent, {}):
            self._neighbours.setdefault(parent, {})[child] = T_parent_child
            self._neighbours.setdefault(child, {})[parent] = inverse(T_parent_child)

    def edges(self) -> Iterator[tuple[str, str, Array]]:
        """All transforms: parent, child, ``T_parent_child`` (4, 4); each pair in both directions."""
        for parent, children in self._neighbours.items():
            for child, T_parent_child in children.items():
                yield parent, child, T_parent_child

    def __contains__(self, frame: str) -> bool:
        return frame in self._neighbours

    def find(self, parent: str, child: str) -> Array | None:
        """``T_parent_child`` (4, 4), or None if nothing connects the two."""
        found = {parent: np.eye(4)}
        waiting = deque([parent])
        while waiting and child not in found:
            frame = waiting.popleft()
            for other, T_frame_other in self._neighbours.get(frame, {}).items():
                if other not in found:
                    found[other] = found[frame] @ T_frame_other
                    waiting.append(other)
        return found.get(child)


def pose_matrix(position_m: Array | list[float], quat_xyzw: Array) -> Array:
    """The transform (4, 4) of a position and a quaternion, which is made a unit one."""
    return transform(rotations_from_quats(quat_xyzw[None] / np.linalg.norm(quat_xyzw))[0], position_m)


def inverse(T: Array) -> Array:
    """The inverse of a rigid transform (4, 4)."""
    R, t = T[:3, :3], T[:3, 3]
    result = np.eye(4)
    result[:3, :3] = R.T
    result[:3, 3] = -R.T @ t
    return result


# Calibration files of Kalibr (Furgale, Rehder, Siegwart, IROS 2013): ``camchain.yaml``, ``camchain-imucam.yaml``,
# ``imu.yaml``.
#
# https://github.com/ethz-asl/kalibr/wiki/yaml-formats describes them.


_MODELS: dict[tuple[str, str], CameraModel] = {
    ("pinhole", "radtan"): CameraModel.PINHOLE_RADTAN,
    ("pinhole", "equidistant"): CameraModel.PINHOLE_EQUIDISTANT,
    ("pinhole", "equi"): CameraModel.PINHOLE_EQUIDISTANT,
    ("pinhole", "none"): CameraModel.PINHOLE,
    ("ds", "none"): CameraModel.DOUBLE_SPHERE,
}
_MOST_SHIFT_S = 10.0
_CAMERA_KEYS = frozenset(
    {
        *("camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution", "rostopic"),
        *("T_cam_imu", "T_imu_cam", "T_cn_cnm1", "timeshift_cam_imu", "cam_overlaps"),
    }
)
_IMU_KEYS = frozenset({*ImuNoise.__slots__, "T_i_b", "rostopic", "update_rate", "model"})
"""Other keys may change the result, such as the scales of an IMU, or the time in which a line is read out."""
_CAMERA, _IMU, _SENSOR = re.compile(r"cam\d+"), re.compile(r"imu\d+"), re.compile(r"(cam|imu)\d+")


def is_kalibr(content: Mapping[str, Any]) -> bool:
    """Tell if a YAML file is one of Kalibr's."""
    return "accelerometer_noise_density" in content or any(_SENSOR.fullmatch(key) for key in content)


def read_kalibr(path: Path, content: Mapping[str, Any]) -> KnownCalibration:
    """The cameras and IMUs of one file of Kalibr's; raises InvalidInput naming the file and the field."""
    known = KnownCalibration()
    entries = {"imu0": content} if "accelerometer_noise_density" in content else content
    for name, entry in entries.items():
        part = CalibrationFile(f"{path}: {name}", entry if isinstance(entry, dict) else {})
        if _CAMERA.fullmatch(name):
            frame = f"{path}:{name}"
            more = time_offset(part)
            intrinsics = _intrinsics(part)
            known.sensors.append(
                KnownSensor(name, SensorKind.CAMERA, part.word("rostopic", ""), frame, intrinsics, more=more)
            )
            T_cam_imu, T_imu_cam = _transform(part, "T_cam_imu"), _transform(part, "T_imu_cam")
            if T_cam_imu is not None:
                T_imu_cam = inverse(T_cam_imu)
            if T_imu_cam is not None:
                known.transforms.append(("imu0", frame, T_imu_cam))
            T_cam_previous = _transform(part, "T_cn_cnm1")
            if T_cam_previous is not None:
                known.transforms.append((f"{path}:cam{int(name[3:]) - 1}", frame, inverse(T_cam_previous)))
            known.notes += unread_keys(part, _CAMERA_KEYS, f"{name} in {path.name}")
        elif _IMU.fullmatch(name):
            noise = ImuNoise(**{key: part.optional(key) for key in ImuNoise.__slots__})
            known.sensors.append(KnownSensor(name, SensorKind.IMU, part.word("rostopic", ""), name, noise=noise))
            T_imu_body = _transform(part, "T_i_b")
            if T_imu_body is not None and name != "imu0":
                known.transforms.append((name, "imu0", T_imu_body))
            known.notes += unread_keys(part, _IMU_KEYS, f"{name} in {path.name}")
        else:
            known.notes.append(f"{name} of {path.name} is not read")
    return known


def time_offset(entry: CalibrationFile) -> dict[str, CalibrationValue]:
    """The time offset of a camera, as ``dataset.yaml`` has it; empty without one. Raises InvalidInput."""
    shift_s = entry.optional("timeshift_cam_imu")
    if shift_s is not None and abs(shift_s) > _MOST_SHIFT_S:
        raise InvalidInput(f"{entry.name}: timeshift_cam_imu is {shift_s:g} s", "expected seconds, -10 to 10")
    return {TIME_OFFSET: shift_s} if shift_s else {}


def unread_keys(entry: CalibrationFile, read: frozenset[str], place: str) -> list[str]:
    """A note on the keys of a sensor that are not in ``read``, or none. A time offset of 0 says nothing."""
    unread = [
        str(key) for key, value in entry.content.items() if key not in read and (key, value) != ("time_offset", 0)
    ]
    return [f"{', '.join(unread)} of {place} {'is' if len(unread) == 1 else 'are'} not read"] if unread else []


def _intrinsics(entry: CalibrationFile) -> CameraIntrinsics:
    kind, distortion = entry.word("camera_model"), entry.word("distortion_model", "none")
    if (kind, distortion) not in _MODELS:
        known = ", ".join(f"{first} with {second}" for first, second in _MODELS)
        raise InvalidInput(
            f"{entry.name}: camera model {kind} with distortion {distortion} is not read", f"known: {known}"
        )
    model = _MODELS[kind, distortion]
    width, height = entry.size("resolution")
    if model is CameraModel.DOUBLE_SPHERE:
        xi, alpha, fx, fy, cx, cy = entry.numbers("intrinsics", 6)
        coefficients: tuple[float, ...] = (xi, alpha)
    else:
        fx, fy, cx, cy = entry.numbers("intrinsics", 4)
        coefficients = () if distortion == "none" else entry.numbers("distortion_coeffs")
    if len(coefficients) not in COEFFICIENTS[model]:
        raise InvalidInput(f"{entry.name}: {len(coefficients)} distortion_coeffs do not fit {distortion}")
    return CameraIntrinsics(width, height, fx, fy, cx, cy, model, coefficients)


def _transform(entry: CalibrationFile, key: str) -> Array | None:
    return entry.rigid(key) if key in entry.content else None


# Calibration files of Basalt (Usenko et al., RA-L 2020): JSON with everything under ``value0``.
#
# https://gitlab.com/VladyslavUsenko/basalt/-/blob/master/doc/Calibration.md describes them.


_BASALT_MODELS: dict[str, tuple[CameraModel, tuple[str, ...]]] = {
    "pinhole": (CameraModel.PINHOLE, ()),
    "kb4": (CameraModel.FISHEYE_KB, ("k1", "k2", "k3", "k4")),
    "ds": (CameraModel.DOUBLE_SPHERE, ("xi", "alpha")),
}
_BASALT_NOISE = {
    "gyroscope_noise_density": "gyro_noise_std",
    "gyroscope_random_walk": "gyro_bias_std",
    "accelerometer_noise_density": "accel_noise_std",
    "accelerometer_random_walk": "accel_bias_std",
}


def read_basalt(path: Path, content: Mapping[str, Any]) -> KnownCalibration:
    """The cameras and the IMU of a file of Basalt's; raises InvalidInput naming the file and the field."""
    whole = CalibrationFile(str(path), dict(content)).part("value0")
    known = KnownCalibration()
    poses, cameras, sizes = whole.parts("T_imu_cam"), whole.parts("intrinsics"), whole.content.get("resolution")
    if not isinstance(sizes, list) or not len(poses) == len(cameras) == len(sizes):
        raise InvalidInput(f"{whole.name}: T_imu_cam, intrinsics and resolution are no lists of one length")
    shift_s = (whole.optional("cam_time_offset_ns") or 0.0) * 1e-9
    if abs(shift_s) > _MOST_SHIFT_S:
        raise InvalidInput(f"{whole.name}: cam_time_offset_ns is {shift_s:g} s", "expected at most 10 s")
    more: dict[str, CalibrationValue] = {TIME_OFFSET: shift_s} if shift_s else {}
    for number, (pose, camera) in enumerate(zip(poses, cameras, strict=True)):
        kind = camera.word("camera_type")
        if kind not in _BASALT_MODELS:
            models = ", ".join(_BASALT_MODELS)
            raise InvalidInput(f"{camera.name}: camera_type {kind} is not read", f"known: {models}")
        model, keys = _BASALT_MODELS[kind]
        values = camera.part("intrinsics")
        width, height = CalibrationFile(camera.name, {"resolution": sizes[number]}).size("resolution")
        fx, fy, cx, cy = (values.number(key) for key in ("fx", "fy", "cx", "cy"))
        coefficients = tuple(values.number(key) for key in keys)
        name, frame = f"cam{number}", f"{path}:cam{number}"
        intrinsics = CameraIntrinsics(width, height, fx, fy, cx, cy, model, coefficients)
        known.sensors.append(KnownSensor(name, SensorKind.CAMERA, "", frame, intrinsics, more=more))
        quat_xyzw = np.array([pose.number(f"q{axis}") for axis in "xyzw"])
        norm = float(np.linalg.norm(quat_xyzw))
        if not 0.99 < norm < 1.01:
            raise InvalidInput(f"{pose.name}: the quaternion has norm {norm:g}", "copy the file again")
        T_imu_cam = pose_matrix([pose.number(f"p{axis}") for axis in "xyz"], quat_xyzw)
        known.transforms.append(("imu0", frame, T_imu_cam))
    noise = {key: float(np.mean(whole.numbers(given, 1, 3))) for key, given in _BASALT_NOISE.items()}
    known.sensors.append(KnownSensor("imu0", SensorKind.IMU, "", "imu0", noise=ImuNoise(**noise)))
    biases = [key for key in ("calib_accel_bias", "calib_gyro_bias") if any(whole.numbers(key))]
    if biases:
        known.notes.append(f"{' and '.join(biases)} of {path.name} {'is' if len(biases) == 1 else 'are'} not read")
    return known


# Calibration files that users give: those of Kalibr and Basalt, and ``dataset.yaml``.


BODY = "body"
_CAMERAS = {SensorKind.CAMERA, SensorKind.DEPTH}


def read_calibrations(paths: Sequence[Path]) -> KnownCalibration:
    """All that the files say; raises InvalidInput naming the file that is none, or that says something twice."""
    known = KnownCalibration()
    owners: dict[tuple[SensorKind, str], Path] = {}
    for path in paths:
        found = read_calibration(path)
        for sensor in found.sensors:
            earlier = owners.setdefault((sensor.kind, sensor.topic or sensor.name), path)
            if earlier != path:
                raise InvalidInput(f"{earlier} and {path} both calibrate {sensor.name}", "give one of them")
        known.sensors += found.sensors
        known.transforms += found.transforms
        known.notes += found.notes
    return known


def read_calibration(path: Path) -> KnownCalibration:
    """Read one file; raises InvalidInput, or NotFound if there is no such file."""
    content = read_calibration_file(path).content
    if isinstance(content.get("sensors"), list):
        known = KnownCalibration()
        for sensor in load_sensors(path):
            intrinsics = CameraIntrinsics.of(sensor) if sensor.kind in _CAMERAS else None
            noise = ImuNoise.of(sensor) if sensor.kind is SensorKind.IMU else None
            known.sensors.append(
                KnownSensor(
                    sensor.name, sensor.kind, sensor.topic, sensor.name, intrinsics, noise, dict(sensor.calibration)
                )
            )
            known.transforms.append((BODY, sensor.name, np.array(sensor.T_body_sensor).reshape(4, 4)))
        return known
    if is_kalibr(content):
        return read_kalibr(path, content)
    if isinstance(content.get("value0"), dict):
        return read_basalt(path, content)
    raise InvalidInput(
        f"{path} is no calibration that is read",
        "expected Kalibr's camchain.yaml (cam0: ...) or imu.yaml, Basalt's calibration.json (value0: ...), or a "
        "dataset.yaml (sensors: ...)",
    )


# The intrinsics that users give with ``--calibration`` for a recording of one camera.


def given_camera(paths: tuple[Path, ...]) -> CameraIntrinsics | None:
    """The intrinsics of the first camera in the files, None without files; raises InvalidInput."""
    if not paths:
        return None
    for sensor in read_calibrations(paths).sensors:
        if sensor.kind is SensorKind.CAMERA and sensor.intrinsics is not None:
            return sensor.intrinsics
    names = ", ".join(str(path) for path in paths)
    raise InvalidInput(f"{names} has no camera", "give Kalibr's camchain.yaml (cam0: ...) or a dataset.yaml")
