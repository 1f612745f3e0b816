"""The intrinsics that users give with ``--calibration``: a ``dataset.yaml``, or Kalibr's ``camchain.yaml``."""

from __future__ import annotations

from pathlib import Path

from slamhive.bags.calibration_file import CalibrationFile, read_calibration_file
from slamhive.domain.calibration import COEFFICIENTS, CameraIntrinsics, CameraModel
from slamhive.domain.sensors import CalibrationValue, Sensor, SensorKind
from slamhive.errors import InvalidInput

_KALIBR_MODELS = {"radtan": CameraModel.PINHOLE_RADTAN, "equidistant": CameraModel.FISHEYE_KB}


def given_camera(paths: tuple[Path, ...]) -> CameraIntrinsics | None:
    """The intrinsics of the first camera in the only file of ``paths``, None without one; raises InvalidInput."""
    if not paths:
        return None
    if len(paths) > 1:
        raise InvalidInput(f"{len(paths)} calibration files are given", "give the one of the camera")
    file = read_calibration_file(paths[0])
    if "cam0" in file.content:
        return _of_kalibr(file.part("cam0"))
    for part in file.parts("sensors"):
        if part.content.get("kind") == SensorKind.CAMERA:
            return _of_dataset(part)
    raise InvalidInput(
        f"{file.name} has no camera", "give Kalibr's camchain.yaml (cam0: ...) or a dataset.yaml (sensors: ...)"
    )


def _of_kalibr(part: CalibrationFile) -> CameraIntrinsics:
    model = _KALIBR_MODELS.get(part.word("distortion_model"))
    if part.word("camera_model") != "pinhole" or model is None:
        raise InvalidInput(
            f"{part.name}: {part.word('camera_model')} with {part.word('distortion_model')} is unknown",
            f"use pinhole with {' or '.join(_KALIBR_MODELS)}",
        )
    width, height = part.size("resolution")
    fx, fy, cx, cy = part.numbers("intrinsics", 4)
    distortion = part.numbers("distortion_coeffs", *COEFFICIENTS[model])
    return CameraIntrinsics(width, height, fx, fy, cx, cy, model, distortion)


def _of_dataset(part: CalibrationFile) -> CameraIntrinsics:
    values = part.part("calibration").content
    known: dict[str, CalibrationValue] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in values.items()
    }
    for key in ("width", "height", "fx", "fy", "cx", "cy"):
        part.part("calibration").number(key)
    if "distortion" in known:
        part.part("calibration").numbers("distortion")
    return CameraIntrinsics.of(Sensor(part.name, SensorKind.CAMERA, "/cam0", 1.0, calibration=known))
