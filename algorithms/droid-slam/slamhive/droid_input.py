"""Inputs and outputs of DROID-SLAM, without a GPU: arguments, images, intrinsics, the scale of a stereo pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.runtime.calibration import RADTAN, camera_matrix, check_model, distortion, transform
from slamhive.runtime.network_images import blue_first, resized, undistorted

MULTIPLE_PX = 8
"""Height and width of the network's images are multiples of this."""
ASSUMED_BASELINE_M = 0.1
"""Upstream's geometry of a stereo pair (``projective_ops.py``); its script for EuRoC scales by 1.10."""
FIXED = {"disable_vis": True, "upsample": False, "frontend_nms": 1, "frontend_radius": 2, "backend_radius": 2}
PARAMETERS = (
    "buffer",
    "beta",
    "filter_thresh",
    "warmup",
    "keyframe_thresh",
    "frontend_thresh",
    "frontend_window",
    "backend_thresh",
    "backend_nms",
)


def arguments_of(values: Mapping[str, Any], weights: str, size: tuple[int, int], *, stereo: bool) -> dict[str, Any]:
    """Arguments that upstream's ``demo.py`` takes from its command line."""
    chosen = {key: values[key] for key in PARAMETERS}
    return {**FIXED, "weights": weights, "image_size": list(size), "stereo": stereo, **chosen}


class Cameras:
    """Makes the images of one camera, or of a rectified pair.

    Raises InvalidInput for images that cannot be undistorted here: those of a pair have to be rectified together.
    """

    def __init__(self, values: Mapping[str, Any], roles: Sequence[str]) -> None:
        if len(roles) > 1 and any(distortion(values, role) for role in roles):
            raise InvalidInput(
                "DROID-SLAM needs rectified images of a stereo pair", "rectify the images of the cameras"
            )
        check_model(values, "left", RADTAN, 5, "DROID-SLAM")
        self._values = values
        self._K = camera_matrix(values, "left")
        self._coefficients = distortion(values, "left")
        self.size = network_size(int(values["left_height"]), int(values["left_width"]), int(values["pixels"]))

    @property
    def intrinsics(self) -> list[float]:
        """fx, fy, cx, cy of the left camera, in pixels of the network's images."""
        x = self.size[1] / int(self._values["left_width"])
        y = self.size[0] / int(self._values["left_height"])
        K = self._K
        return [float(value) for value in (K[0, 0] * x, K[1, 1] * y, K[0, 2] * x, K[1, 2] * y)]

    def images(self, recorded: Sequence[np.ndarray]) -> np.ndarray:
        """(n, 3, h, w) uint8, blue first as OpenCV reads images, in the size that the network gets."""
        whole = [undistorted(blue_first(image), self._K, self._coefficients) for image in recorded]
        return np.stack([np.ascontiguousarray(resized(image, *self.size).transpose(2, 0, 1)) for image in whole])

    def in_metres(self, table: np.ndarray) -> np.ndarray:
        """Poses (n, 7) of a pair in m: upstream takes the pair's baseline for 0.1 m."""
        baseline_m = float(np.linalg.norm(transform(self._values, "left", "right")[:3, 3]))
        scaled = np.array(table, dtype=np.float64)
        scaled[:, :3] *= baseline_m / ASSUMED_BASELINE_M
        return scaled


def network_size(height: int, width: int, pixels: int) -> tuple[int, int]:
    """Height and width of about so many pixels in all, in the shape of the image."""
    factor = np.sqrt(pixels / (height * width))
    tall, wide = (max(MULTIPLE_PX, int(side * factor) // MULTIPLE_PX * MULTIPLE_PX) for side in (height, width))
    return tall, wide
