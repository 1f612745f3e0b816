"""The intrinsics that users give with ``--calibration`` for a recording of one camera."""

from __future__ import annotations

from pathlib import Path

from slamhive.bags.formats.calibration_files import read_calibrations
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.sensors import SensorKind
from slamhive.errors import InvalidInput


def given_camera(paths: tuple[Path, ...]) -> CameraIntrinsics | None:
    """The intrinsics of the first camera in the files, None without files; raises InvalidInput."""
    if not paths:
        return None
    for sensor in read_calibrations(paths).sensors:
        if sensor.kind is SensorKind.CAMERA and sensor.intrinsics is not None:
            return sensor.intrinsics
    names = ", ".join(str(path) for path in paths)
    raise InvalidInput(f"{names} has no camera", "give Kalibr's camchain.yaml (cam0: ...) or a dataset.yaml")
