"""Calibration files that users give: those of Kalibr, and ``dataset.yaml``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slamhive.bags.calibration_file import read_calibration_file
from slamhive.bags.formats.kalibr import is_kalibr, read_kalibr
from slamhive.bags.formats.known_calibration import KnownCalibration, KnownSensor
from slamhive.catalogue.dataset_file import load_sensors
from slamhive.domain.calibration import CameraIntrinsics, ImuNoise
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import InvalidInput

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
    """What one file says; raises InvalidInput, or NotFound if there is no such file."""
    content = read_calibration_file(path).content
    if isinstance(content.get("sensors"), list):
        return _of_sensors(load_sensors(path))
    if is_kalibr(content):
        return read_kalibr(path, content)
    raise InvalidInput(
        f"{path} is no calibration that is read",
        "expected Kalibr's camchain.yaml (cam0: ...) or imu.yaml, or a dataset.yaml (sensors: ...)",
    )


def _of_sensors(sensors: Sequence[Sensor]) -> KnownCalibration:
    known = KnownCalibration()
    for sensor in sensors:
        intrinsics = CameraIntrinsics.of(sensor) if sensor.kind in _CAMERAS else None
        noise = ImuNoise.of(sensor) if sensor.kind is SensorKind.IMU else None
        known.sensors.append(
            KnownSensor(
                sensor.name, sensor.kind, sensor.topic, sensor.name, intrinsics, noise, dict(sensor.calibration)
            )
        )
        known.transforms.append((BODY, sensor.name, np.array(sensor.T_body_sensor).reshape(4, 4)))
    return known
