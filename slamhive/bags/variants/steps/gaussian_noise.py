"""The fault ``gaussian_noise``: the noise of the sensor's electronics."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, SeededStep, Stream
from slamhive.bags.variants.steps.images import FULL_SCALE_8BIT, change_light
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor, SensorKind


class GaussianNoise(SeededStep):
    """White noise of the same strength everywhere in the image, new in every frame."""

    kind: ClassVar[str] = "gaussian_noise"

    sigma: float = option("Standard deviation on the scale 0 to 255.", unit="grey levels", ge=0, le=255)

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """No noise."""
        return self.sigma == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """Noise on every image."""
        return Operation(transform=self._degrade)

    def _degrade(self, image: Array, message: Message) -> Array:
        return add_gaussian_noise(image, self.sigma, message.random())


def add_gaussian_noise(image: Array, sigma: float, random: np.random.Generator) -> Array:
    """``image`` with noise of standard deviation ``sigma``, in grey levels of 255; clipped to the image's range."""
    strength = np.float32(sigma / FULL_SCALE_8BIT)

    def change(light: Array) -> Array:
        noisy: Array = light + strength * random.standard_normal(light.shape, dtype=np.float32)
        return noisy

    return change_light(image, change)
