"""The fault ``motion_blur``: the camera moved while the shutter was open."""

from __future__ import annotations

import math
from typing import ClassVar

import cv2
import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, SeededStep, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor, SensorKind

_SAMPLES_PER_PIXEL = 8


class MotionBlur(SeededStep):
    """Every image smeared along a straight line.

    Without ``angle_deg`` each frame has a direction of its own; cameras with the same seed share it, as those of one
    rig do.
    """

    kind: ClassVar[str] = "motion_blur"

    length_px: float = option("Length of the smear.", unit="px", ge=0, le=200)
    angle_deg: float | None = option(
        "Direction, 0 along the rows, 90 downwards; random for each frame if left out.",
        unit="deg",
        default=None,
        ge=-360,
        le=360,
    )

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """No smear."""
        return self.length_px == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """A convolution of every image."""
        return Operation(transform=self._degrade)

    def _degrade(self, image: Array, message: Message) -> Array:
        angle_deg = self.angle_deg
        if angle_deg is None:
            angle_deg = float(np.random.default_rng((self.seed, message.index)).uniform(0.0, 180.0))
        blurred: Array = cv2.filter2D(image, -1, line_kernel(self.length_px, angle_deg))
        return blurred


def line_kernel(length_px: float, angle_deg: float) -> Array:
    """Weights (n, n), n odd, of a straight smear through the middle; their sum is 1."""
    half = length_px / 2
    count = max(2, math.ceil(length_px * _SAMPLES_PER_PIXEL))
    along = (np.arange(count) + 0.5) / count * length_px - half
    angle_rad = math.radians(angle_deg)
    return splat(along * math.cos(angle_rad), along * math.sin(angle_rad), math.ceil(half))


def splat(x: Array, y: Array, radius: int) -> Array:
    """Points (n,) around the origin, each spread over its four pixels bilinearly, as weights with sum 1."""
    size = 2 * radius + 3
    kernel = np.zeros((size, size))
    columns, rows = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - columns, y - rows
    for dx, wx in ((0, 1 - fx), (1, fx)):
        for dy, wy in ((0, 1 - fy), (1, fy)):
            np.add.at(kernel, (rows + dy + radius + 1, columns + dx + radius + 1), wx * wy)
    weights: Array = kernel / kernel.sum()
    return weights
