"""Calibration files of Kalibr (Furgale, Rehder, Siegwart, IROS 2013): ``camchain.yaml``, ``camchain-imucam.yaml``,
``imu.yaml``.

https://github.com/ethz-asl/kalibr/wiki/yaml-formats describes them.
"""  # noqa: D205 - the file names do not fit one line

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.bags.formats.frame_graph import inverse
from slamhive.bags.formats.known_calibration import KnownCalibration, KnownSensor
from slamhive.bags.geometry import Array
from slamhive.domain.calibration import COEFFICIENTS, CameraIntrinsics, CameraModel, ImuNoise
from slamhive.domain.sensors import SensorKind, is_rigid
from slamhive.errors import InvalidInput

_MODELS: dict[tuple[str, str], CameraModel] = {
    ("pinhole", "radtan"): CameraModel.PINHOLE_RADTAN,
    ("pinhole", "equidistant"): CameraModel.PINHOLE_EQUIDISTANT,
    ("pinhole", "equi"): CameraModel.PINHOLE_EQUIDISTANT,
    ("pinhole", "none"): CameraModel.PINHOLE,
    ("ds", "none"): CameraModel.DOUBLE_SPHERE,
}
_CAMERA, _IMU, _SENSOR = re.compile(r"cam\d+"), re.compile(r"imu\d+"), re.compile(r"(cam|imu)\d+")
_NOISE = tuple(ImuNoise.__slots__)
_ORTHONORMAL = 1e-2
"""Kalibr writes all digits; people round them. Rotations this near to one are made orthonormal."""


def is_kalibr(content: Mapping[str, Any]) -> bool:
    """Whether a YAML file is one of Kalibr's."""
    return "accelerometer_noise_density" in content or any(_SENSOR.fullmatch(key) for key in content)


def read_kalibr(path: Path, content: Mapping[str, Any]) -> KnownCalibration:
    """The cameras and IMUs of one file of Kalibr's; raises InvalidInput naming the file and the field."""
    known = KnownCalibration()
    entries = {"imu0": content} if "accelerometer_noise_density" in content else content
    for name, entry in entries.items():
        if not isinstance(entry, dict):
            continue
        if _CAMERA.fullmatch(name):
            _add_camera(known, name, _Entry(path, name, entry))
        elif _IMU.fullmatch(name):
            _add_imu(known, name, _Entry(path, name, entry))
    return known


class _Entry:
    """One camera or IMU of the file ``path``."""

    def __init__(self, path: Path, name: str, fields: Mapping[str, Any]) -> None:
        self.place = f"{path}: {name}"
        self.fields = fields

    def text(self, key: str, default: str | None = None) -> str:
        value = self.fields.get(key, default)
        if not isinstance(value, str):
            raise InvalidInput(f"{self.place} lacks {key}" if value is None else f"{self.place}: {key} is no text")
        return value

    def numbers(self, key: str, count: int | None = None) -> list[float]:
        """The list of numbers ``key``; raises InvalidInput if it is none, or has another length than ``count``."""
        value = self.fields.get(key)
        if value is None:
            raise InvalidInput(f"{self.place} lacks {key}", "compare the file with one that Kalibr wrote")
        fits = isinstance(value, list) and all(isinstance(number, int | float) for number in value)
        if not fits or (count is not None and len(value) != count):
            wanted = "numbers" if count is None else f"{count} numbers"
            raise InvalidInput(f"{self.place}: {key} {str(value)[:80]!r} is no list of {wanted}")
        return [float(number) for number in value]

    def transform(self, key: str) -> Array | None:
        """The rigid transform ``key`` (4, 4), its rotation made orthonormal; None if it is not there."""
        rows = self.fields.get(key)
        if rows is None:
            return None
        fits = isinstance(rows, list) and all(isinstance(row, list) for row in rows)
        numbers = [number for row in rows for number in row] if fits else []
        if len(numbers) != 16 or not all(isinstance(number, int | float) for number in numbers):
            raise InvalidInput(f"{self.place}: {key} is no matrix of 4 rows of 4 numbers")
        T = np.array(numbers, dtype=np.float64).reshape(4, 4)
        R = T[:3, :3]
        if not np.isfinite(T).all() or np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL:
            raise InvalidInput(f"{self.place}: the rotation of {key} is not orthonormal")
        U, _, V = np.linalg.svd(R)
        T[:3, :3] = U @ V
        if not is_rigid(tuple(T.reshape(-1).tolist())):
            raise InvalidInput(f"{self.place}: {key} is no rigid transform", "its last row must be 0 0 0 1")
        return T


def _add_camera(known: KnownCalibration, name: str, entry: _Entry) -> None:
    known.sensors.append(
        KnownSensor(name, SensorKind.CAMERA, entry.text("rostopic", ""), intrinsics=_intrinsics(entry))
    )
    T_cam_imu, T_imu_cam = entry.transform("T_cam_imu"), entry.transform("T_imu_cam")
    if T_cam_imu is not None:
        T_imu_cam = inverse(T_cam_imu)
    if T_imu_cam is not None:
        known.transforms.append(("imu0", name, T_imu_cam))
    T_cam_previous = entry.transform("T_cn_cnm1")
    if T_cam_previous is not None:
        known.transforms.append((f"cam{int(name[3:]) - 1}", name, inverse(T_cam_previous)))


def _intrinsics(entry: _Entry) -> CameraIntrinsics:
    kind, distortion = entry.text("camera_model"), entry.text("distortion_model", "none")
    if (kind, distortion) not in _MODELS:
        known = ", ".join(f"{first} with {second}" for first, second in _MODELS)
        raise InvalidInput(
            f"{entry.place}: camera model {kind} with distortion {distortion} is not read", f"known: {known}"
        )
    model = _MODELS[kind, distortion]
    width, height = entry.numbers("resolution", 2)
    if model is CameraModel.DOUBLE_SPHERE:
        xi, alpha, fx, fy, cx, cy = entry.numbers("intrinsics", 6)
        coefficients: tuple[float, ...] = (xi, alpha)
    else:
        fx, fy, cx, cy = entry.numbers("intrinsics", 4)
        coefficients = () if distortion == "none" else tuple(entry.numbers("distortion_coeffs"))
    if len(coefficients) not in COEFFICIENTS[model]:
        raise InvalidInput(f"{entry.place}: {len(coefficients)} distortion_coeffs do not fit {distortion}")
    return CameraIntrinsics(int(width), int(height), fx, fy, cx, cy, model, coefficients)


def _add_imu(known: KnownCalibration, name: str, entry: _Entry) -> None:
    values = {key: entry.fields.get(key) for key in _NOISE}
    for key, value in values.items():
        if value is not None and not (isinstance(value, int | float) and value >= 0):
            raise InvalidInput(f"{entry.place}: {key} {value!r} is no number of at least 0")
    noise = ImuNoise(**{key: None if value is None else float(value) for key, value in values.items()})
    known.sensors.append(KnownSensor(name, SensorKind.IMU, entry.text("rostopic", ""), noise=noise))
    T_imu_body = entry.transform("T_i_b")
    if T_imu_body is not None and name != "imu0":
        known.transforms.append((name, "imu0", T_imu_body))
