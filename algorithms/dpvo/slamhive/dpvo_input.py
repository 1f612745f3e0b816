"""Inputs of DPVO, made without a GPU: its settings, images and intrinsics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slamhive.runtime.calibration import RADTAN, camera_matrix, check_model, distortion
from slamhive.runtime.network_images import blue_first, cut_to_multiple, undistorted

SETTINGS = {
    "patches": "PATCHES_PER_FRAME",
    "buffer_size": "BUFFER_SIZE",
    "removal_window": "REMOVAL_WINDOW",
    "optimization_window": "OPTIMIZATION_WINDOW",
    "patch_lifetime": "PATCH_LIFETIME",
    "keyframe_threshold": "KEYFRAME_THRESH",
    "mixed_precision": "MIXED_PRECISION",
}
MULTIPLE_PX = 16
"""Height and width of the network's images are multiples of this."""


def settings_of(values: Mapping[str, Any]) -> list[Any]:
    """Names of DPVO's settings, each with its value, as its ``cfg.merge_from_list`` takes them."""
    return [part for key, name in SETTINGS.items() for part in (name, values[key])]


class Camera:
    """Makes the images of one camera. Raises InvalidInput for a lens that OpenCV cannot undistort so."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        check_model(values, "left", RADTAN, 5, "DPVO")
        self._K = camera_matrix(values, "left")
        self._coefficients = distortion(values, "left")

    @property
    def intrinsics(self) -> list[float]:
        """fx, fy, cx, cy in pixels; cutting the image changes none of them."""
        return [float(self._K[row, column]) for row, column in ((0, 0), (1, 1), (0, 2), (1, 2))]

    def image(self, recorded: np.ndarray) -> np.ndarray:
        """(h, w, 3) uint8, undistorted, blue first as OpenCV reads images, cut to a size that the network takes."""
        return cut_to_multiple(undistorted(blue_first(recorded), self._K, self._coefficients), MULTIPLE_PX)
