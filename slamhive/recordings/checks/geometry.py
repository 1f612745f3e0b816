"""Camera and motion geometry that several checks share. Points on the plane z = 1 are "normalised"."""

from __future__ import annotations

from typing import Any

import numpy as np

from slamhive.domain.calibration import CameraModel, distortion_of
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.checks.evidence import Array

_RADTAN = (CameraModel.PINHOLE, CameraModel.PINHOLE_RADTAN)
_FISHEYE = (CameraModel.PINHOLE_EQUIDISTANT, CameraModel.FISHEYE_KB)
NARROWEST_DEG, WIDEST_DEG = 10.0, 170.0
"""Fields of view of cameras with a perspective model. A focal length for another resolution leaves the middle first."""
FOCAL_RATIO = (0.8, 1.25)
CENTRE_SHARE = 0.2
"""How far the principal point may be from the middle of the image, as a share of its size."""
TYPICAL = 0.35
NEAREST_M = 0.1
"""Nothing that a camera sees is nearer."""


def matrix(T: tuple[float, ...]) -> Array:
    """A transform of ``dataset.yaml`` as (4, 4)."""
    return np.array(T, dtype=np.float64).reshape(4, 4)


def calibrated(sensor: Sensor, key: str) -> float:
    """A number of the sensor's calibration."""
    value: Any = sensor.calibration[key]
    return float(value)


def focal_px(sensor: Sensor) -> float:
    """The mean focal length."""
    return (calibrated(sensor, "fx") + calibrated(sensor, "fy")) / 2


def depth_of(camera: Sensor, dataset: Dataset) -> Sensor | None:
    """The depth camera that shares the pixels of ``camera``."""
    for depth in dataset.of_kind(SensorKind.DEPTH):
        if depth.calibration.get("registered_to") == camera.name:
            return depth
    return None


def doubtful_centre(sensor: Sensor) -> float | None:
    """Distance of the principal point from the middle, as a share of the image size, if it is too large."""
    off = max(
        abs(calibrated(sensor, c) / calibrated(sensor, size) - 0.5) for c, size in (("cx", "width"), ("cy", "height"))
    )
    return off if off > CENTRE_SHARE else None


def doubtful_view_deg(sensor: Sensor) -> float | None:
    """The horizontal field of view if it, or the ratio of the focal lengths, is none of a camera."""
    fx, fy = calibrated(sensor, "fx"), calibrated(sensor, "fy")
    angle_deg = float(np.rad2deg(2 * np.arctan2(calibrated(sensor, "width") / 2, fx)))
    likely = NARROWEST_DEG <= angle_deg <= WIDEST_DEG and FOCAL_RATIO[0] <= fx / fy <= FOCAL_RATIO[1]
    return None if likely else angle_deg


def can_undistort(sensor: Sensor) -> bool:
    """Tell if :func:`normalised` knows the camera's model, and its intrinsics are possible."""
    if doubtful_centre(sensor) is not None or doubtful_view_deg(sensor) is not None:
        return False
    return not _distortion(sensor).any() or _model(sensor) in (*_RADTAN, *_FISHEYE)


def normalised(sensor: Sensor, pixels: Array) -> Array:
    """Undistorted points on z = 1, (n, 2), of pixels (n, 2); needs :func:`can_undistort`."""
    fx, fy, cx, cy = (calibrated(sensor, key) for key in ("fx", "fy", "cx", "cy"))
    distortion = _distortion(sensor)
    if not distortion.any():
        return np.asarray((pixels - (cx, cy)) / (fx, fy))
    import cv2  # noqa: PLC0415 - only distorted images need it

    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    points = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
    if _model(sensor) in _FISHEYE:
        return np.asarray(cv2.fisheye.undistortPoints(points, K, distortion[:4])).reshape(-1, 2)
    return np.asarray(cv2.undistortPoints(points, K, distortion)).reshape(-1, 2)


def _model(sensor: Sensor) -> str:
    return str(sensor.calibration.get("model", CameraModel.PINHOLE))


def _distortion(sensor: Sensor) -> Array:
    return np.array(() if sensor.calibration.get("rectified") else distortion_of(sensor.calibration))


def homogeneous(points: Array) -> Array:
    """Normalised points (n, 2) as rays (n, 3)."""
    return np.column_stack((points, np.ones(len(points))))


def misfits(first: Array, second: Array, T_second_first: Array) -> Array:
    """Distance of each second point from where its first point can be, (n,), on the plane z = 1.

    A point of unknown depth Z lies on the segment from the projection of R x (Z infinite) to that of R x + t / Z, Z
    being :data:`NEAREST_M`. Unlike the distance from the epipolar line, this holds without translation too, and it
    notices points behind the camera.

    Args:
        first: (n, 2) in the first camera.
        second: (n, 2) in the second camera.
        T_second_first: Pose of the first camera in the second one, (4, 4).
    """
    far = homogeneous(first) @ T_second_first[:3, :3].T
    t = T_second_first[:3, 3]
    # Depth in the second camera must stay positive: 1/Z goes as far as that allows.
    most = np.full(len(far), 1.0 / NEAREST_M)
    if t[2] < 0:
        most = np.minimum(most, 0.9 * np.maximum(far[:, 2], 0.0) / -t[2])
    near = far + most[:, None] * t
    behind = (far[:, 2] <= 1e-3) | (near[:, 2] <= 1e-3)
    begin = far[:, :2] / np.where(behind, 1.0, far[:, 2])[:, None]
    end = near[:, :2] / np.where(behind, 1.0, near[:, 2])[:, None]
    along = end - begin
    length2 = np.maximum((along**2).sum(axis=1), 1e-18)
    part = np.clip(((second - begin) * along).sum(axis=1) / length2, 0.0, 1.0)
    apart = np.linalg.norm(second - (begin + part[:, None] * along), axis=1)
    return np.asarray(np.where(behind, np.inf, apart))


def typical(apart: Array) -> float:
    """A distance that a good third of the matches keeps.

    Not the median: in scenes with repeated structure up to half of the matches are wrong (EuRoC V1_01: 45 %).
    """
    return float(np.quantile(apart, TYPICAL))


def depths_by_triangulation(first: Array, second: Array, T_second_first: Array) -> Array:
    """Depth of each point in the first camera, (n,), by least squares; NaN where the rays hardly converge.

    ``second`` x (Z R x + t) = 0 is linear in Z.
    """
    rays = homogeneous(first) @ T_second_first[:3, :3].T
    across, offset = np.cross(homogeneous(second), rays), np.cross(homogeneous(second), T_second_first[:3, 3])
    squared = (across**2).sum(axis=1)
    parallax = np.sqrt((offset**2).sum(axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = -(across * offset).sum(axis=1) / squared
    usable = (depths > NEAREST_M) & (parallax > 1e-6) & (np.sqrt(squared) > 2e-3)
    return np.asarray(np.where(usable, depths, np.nan))


def explained_share(first: Array, second: Array, tolerance: float) -> float:
    """Share of the matches that some rigid motion explains, by RANSAC of the essential matrix."""
    import cv2  # noqa: PLC0415 - only doubtful matches come here

    if len(first) < 8:
        return 0.0
    _, mask = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.999, tolerance)
    return 0.0 if mask is None else float(np.mean(mask))
