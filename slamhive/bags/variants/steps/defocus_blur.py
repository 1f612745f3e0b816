"""The fault ``defocus_blur``: a lens out of focus."""

from __future__ import annotations

import math
from typing import ClassVar

import cv2
import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, Step, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor, SensorKind

_OVERSAMPLING = 8


class DefocusBlur(Step):
    """Every image convolved with a disk, the circle of confusion."""

    kind: ClassVar[str] = "defocus_blur"

    radius_px: float = option("Radius of the disk that a point becomes.", unit="px", ge=0, le=100)

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """In focus."""
        return self.radius_px == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """A convolution of every image."""
        kernel = disk_kernel(self.radius_px)

        def degrade(image: Array, _message: Message) -> Array:
            blurred: Array = cv2.filter2D(image, -1, kernel)
            return blurred

        return Operation(transform=degrade)


def disk_kernel(radius_px: float) -> Array:
    """Weights (n, n), n odd, with sum 1: how much of each pixel the disk around the middle covers."""
    reach = math.ceil(radius_px - 0.5) if radius_px > 0.5 else 0
    size = 2 * reach + 1
    centres = (np.arange(size * _OVERSAMPLING) + 0.5) / _OVERSAMPLING - size / 2
    inside = centres[:, None] ** 2 + centres[None, :] ** 2 <= radius_px**2
    kernel = inside.reshape(size, _OVERSAMPLING, size, _OVERSAMPLING).sum(axis=(1, 3)).astype(np.float64)
    kernel[reach, reach] = max(kernel[reach, reach], 1.0)
    weights: Array = kernel / kernel.sum()
    return weights
