"""What the steps on camera images share: the scale of pixel values, and changes that leave transparency alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from slamhive.bags.variants.step import Array

FULL_SCALE_8BIT = 255.0
"""Grey levels are given on the scale of 8 bits, whatever the image has."""


def full_scale(image: Array) -> float:
    """The value of white: the largest of an integer type, 1 for floats."""
    return float(np.iinfo(image.dtype).max) if np.issubdtype(image.dtype, np.integer) else 1.0


def change_light(image: Array, change: Callable[[Array], Array]) -> Array:
    """Apply ``change`` to the pixel values as float32 0..1, clip, round back to the image's type.

    A fourth channel is transparency and stays.
    """
    white = full_scale(image)
    light = image[..., :3] if image.ndim == 3 else image
    changed = np.clip(change(light.astype(np.float32) / np.float32(white)), 0.0, 1.0) * np.float32(white)
    if np.issubdtype(image.dtype, np.integer):
        np.rint(changed, out=changed)
    result = changed.astype(image.dtype)
    if image.ndim == 3 and image.shape[2] == 4:
        return np.concatenate([result, image[..., 3:]], axis=2)
    return result


def lookup(image: Array, curve: Callable[[Array], Array]) -> Array:
    """Apply ``curve`` (0..1 to 0..1, elementwise) to every pixel; integer images through a table."""
    if not np.issubdtype(image.dtype, np.integer):
        return change_light(image, curve)
    white = full_scale(image)
    values = np.clip(curve(np.arange(int(white) + 1) / white), 0.0, 1.0) * white
    table = np.rint(values).astype(image.dtype)
    result: Array = table[image]
    if image.ndim == 3 and image.shape[2] == 4:
        result[..., 3] = image[..., 3]
    return result
