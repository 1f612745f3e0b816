"""Calibration files of Kalibr (Furgale, Rehder, Siegwart, IROS 2013): ``camchain.yaml``, ``camchain-imucam.yaml``,
``imu.yaml``.

https://github.com/ethz-asl/kalibr/wiki/yaml-formats describes them.
"""  # noqa: D205 - the file names do not fit one line

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slamhive.bags.calibration_file import CalibrationFile
from slamhive.bags.formats.frame_graph import inverse
from slamhive.bags.formats.known_calibration import KnownCalibration, KnownSensor
from slamhive.bags.geometry import Array
from slamhive.domain.calibration import COEFFICIENTS, TIME_OFFSET, CameraIntrinsics, CameraModel, ImuNoise
from slamhive.domain.sensors import CalibrationValue, SensorKind
from slamhive.errors import InvalidInput

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
    """Whether a YAML file is one of Kalibr's."""
    return "accelerometer_noise_density" in content or any(_SENSOR.fullmatch(key) for key in content)


def read_kalibr(path: Path, content: Mapping[str, Any]) -> KnownCalibration:
    """The cameras and IMUs of one file of Kalibr's; raises InvalidInput naming the file and the field."""
    known = KnownCalibration()
    entries = {"imu0": content} if "accelerometer_noise_density" in content else content
    for name, entry in entries.items():
        part = CalibrationFile(f"{path}: {name}", entry if isinstance(entry, dict) else {})
        if _CAMERA.fullmatch(name):
            _add_camera(known, path, name, part)
            _name_unread(known, path, name, part, _CAMERA_KEYS)
        elif _IMU.fullmatch(name):
            _add_imu(known, name, part)
            _name_unread(known, path, name, part, _IMU_KEYS)
        else:
            known.notes.append(f"{name} of {path.name} is not read")
    return known


def _name_unread(known: KnownCalibration, path: Path, name: str, entry: CalibrationFile, read: frozenset[str]) -> None:
    """Note the keys of a sensor that are not read. A time offset of 0 says nothing."""
    unread = [
        str(key) for key, value in entry.content.items() if key not in read and (key, value) != ("time_offset", 0)
    ]
    if unread:
        are = "is" if len(unread) == 1 else "are"
        known.notes.append(f"{', '.join(unread)} of {name} in {path.name} {are} not read")


def _add_camera(known: KnownCalibration, path: Path, name: str, entry: CalibrationFile) -> None:
    frame = f"{path}:{name}"
    shift_s = entry.optional("timeshift_cam_imu")
    if shift_s is not None and abs(shift_s) > _MOST_SHIFT_S:
        raise InvalidInput(f"{entry.name}: timeshift_cam_imu is {shift_s:g} s", "expected seconds, -10 to 10")
    more: dict[str, CalibrationValue] = {TIME_OFFSET: shift_s} if shift_s else {}
    intrinsics = _intrinsics(entry)
    known.sensors.append(KnownSensor(name, SensorKind.CAMERA, entry.word("rostopic", ""), frame, intrinsics, more=more))
    T_cam_imu, T_imu_cam = _transform(entry, "T_cam_imu"), _transform(entry, "T_imu_cam")
    if T_cam_imu is not None:
        T_imu_cam = inverse(T_cam_imu)
    if T_imu_cam is not None:
        known.transforms.append(("imu0", frame, T_imu_cam))
    T_cam_previous = _transform(entry, "T_cn_cnm1")
    if T_cam_previous is not None:
        known.transforms.append((f"{path}:cam{int(name[3:]) - 1}", frame, inverse(T_cam_previous)))


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


def _add_imu(known: KnownCalibration, name: str, entry: CalibrationFile) -> None:
    noise = ImuNoise(**{key: entry.optional(key) for key in ImuNoise.__slots__})
    known.sensors.append(KnownSensor(name, SensorKind.IMU, entry.word("rostopic", ""), name, noise=noise))
    T_imu_body = _transform(entry, "T_i_b")
    if T_imu_body is not None and name != "imu0":
        known.transforms.append((name, "imu0", T_imu_body))


def _transform(entry: CalibrationFile, key: str) -> Array | None:
    return entry.rigid(key) if key in entry.content else None
