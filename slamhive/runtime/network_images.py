"""Images as neural networks take them that learnt from what OpenCV reads: undistorted, blue first, of even sizes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def blue_first(image: Array) -> Array:
    """``image`` (h, w) grey or (h, w, 3) with red first, as (h, w, 3) with blue first."""
    return np.ascontiguousarray(np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., ::-1])


def undistorted(image: Array, K: Array, coefficients: Sequence[float]) -> Array:
    """``image`` without the distortion of a lens, with the same intrinsics; ``coefficients`` as OpenCV orders them."""
    return cv2.undistort(image, K, np.array(coefficients, dtype=np.float64)) if len(coefficients) else image


def cut_to_multiple(image: Array, step_px: int) -> Array:
    """``image`` without what is over a multiple of ``step_px`` at its right and lower border: intrinsics stay."""
    height, width = (size - size % step_px for size in image.shape[:2])
    return np.ascontiguousarray(image[:height, :width])


def resized(image: Array, height: int, width: int) -> Array:
    """``image`` in another size, by bilinear interpolation."""
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
