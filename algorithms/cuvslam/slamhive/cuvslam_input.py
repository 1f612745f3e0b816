"""Inputs of cuVSLAM in plain numbers: cameras, IMU, images. Its bindings take lists, but not every kind of array."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.runtime.calibration import EQUIDISTANT, RADTAN, check_model, distortion, transform
from slamhive.runtime.messages import to_grey
from slamhive.runtime.trajectory import quaternions_xyzw

NOISES = (
    "gyroscope_noise_density",
    "gyroscope_random_walk",
    "accelerometer_noise_density",
    "accelerometer_random_walk",
)
MAJOR = 17
"""The major version of cuVSLAM that this was written for. The next one needs another argument of ``Tracker``."""


@dataclass(frozen=True, slots=True)
class CameraNumbers:
    """A camera: pixels, pose in the frame of the left camera, and its lens (``Brown``, ``Fisheye`` or None)."""

    size: list[int]
    focal: list[float]
    principal: list[float]
    rotation_xyzw: list[float]
    translation_m: list[float]
    model: str | None
    coefficients: list[float]


def check_version(found: tuple[Any, ...]) -> str:
    """The version that ``cuvslam.get_version()`` reports; raises InvalidInput for one with another interface."""
    if int(found[1]) != MAJOR:
        raise InvalidInput(f"this image has cuVSLAM {found[0]}, version {MAJOR} is needed", "build it with that wheel")
    return str(found[0])


def camera_numbers(values: Mapping[str, Any], role: str) -> CameraNumbers:
    """The camera in ``role``. Raises InvalidInput for a lens that cuVSLAM does not know."""
    check_model(values, role, (*RADTAN, *EQUIDISTANT), 5, "cuVSLAM")
    model, coefficients = lens_of(str(values.get(f"{role}_model", RADTAN[0])), distortion(values, role))
    rotation, translation = pose_numbers(transform(values, "left", role))
    return CameraNumbers(
        [int(values[f"{role}_{key}"]) for key in ("width", "height")],
        [float(values[f"{role}_{key}"]) for key in ("fx", "fy")],
        [float(values[f"{role}_{key}"]) for key in ("cx", "cy")],
        rotation,
        translation,
        model,
        coefficients,
    )


def lens_of(model: str, coefficients: list[float]) -> tuple[str | None, list[float]]:
    """Brown's model takes k1, k2, k3, p1, p2, where ours are in OpenCV's order k1, k2, p1, p2, k3."""
    if not coefficients:
        return None, []
    if model in EQUIDISTANT:
        return "Fisheye", coefficients
    k1, k2, p1, p2, k3 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:5]
    return "Brown", [k1, k2, k3, p1, p2]


def imu_noise(values: Mapping[str, Any]) -> dict[str, float]:
    """The IMU's noise and its rate, by the names that cuVSLAM gives them. Raises InvalidInput for what is missing."""
    missing = [name for name in NOISES if not values.get(f"imu_{name}")]
    if missing:
        raise InvalidInput(f"cuVSLAM needs {', '.join(missing)} of the IMU", "add them to dataset.yaml")
    return {**{name: float(values[f"imu_{name}"]) for name in NOISES}, "frequency": float(values["imu_rate_hz"])}


def pose_numbers(T: np.ndarray) -> tuple[list[float], list[float]]:
    """A 4x4 transform as a quaternion, w last, and a translation."""
    return quaternions_xyzw(T[None, :3, :3])[0].tolist(), T[:3, 3].tolist()


def grey(image: np.ndarray) -> np.ndarray:
    """(h, w) uint8 in one piece."""
    return np.ascontiguousarray(to_grey(image), dtype=np.uint8)


def depth(image: np.ndarray) -> np.ndarray:
    """(h, w) uint16 in one piece; raises InvalidInput for depth in floating point, which would lose its fractions."""
    if image.dtype != np.uint16:
        raise InvalidInput(
            f"cuVSLAM needs 16-bit depth, this one is {image.dtype}", "choose a dataset with 16UC1 depth"
        )
    return np.ascontiguousarray(image)


class ImuQueue:
    """Keeps the IMU samples that are later than the frame they came with."""

    def __init__(self) -> None:
        self._waiting = np.empty((0, 7))

    def due(self, samples: np.ndarray, until_s: float) -> np.ndarray:
        """The samples ``t, gyro xyz, acc xyz`` up to ``until_s``, each once and in order."""
        known = np.concatenate([self._waiting, samples])
        now = known[:, 0] <= until_s
        self._waiting = known[~now]
        due: np.ndarray = known[now]
        return due
