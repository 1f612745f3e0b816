"""The fault ``shot_noise``: too little light, counted photon by photon."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, SeededStep, Stream
from slamhive.bags.variants.steps.images import change_light
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor, SensorKind


class ShotNoise(SeededStep):
    """Poisson noise: a pixel of brightness b (0..1) counts ``photons`` * b photons on average, drawn for every frame.

    Dark regions suffer most, relative to what they show (Foi et al., "Practical Poissonian-Gaussian noise modeling and
    fitting for single-image raw-data", 2008).
    """

    kind: ClassVar[str] = "shot_noise"

    photons: float = option("Photons that a white pixel counts; fewer are noisier.", unit="photons", ge=1, le=1e6)

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """Noise on every image."""
        return Operation(transform=self._degrade)

    def _degrade(self, image: Array, message: Message) -> Array:
        return add_shot_noise(image, self.photons, message.random())


def add_shot_noise(image: Array, photons: float, random: np.random.Generator) -> Array:
    """``image`` as counted with ``photons`` for white; clipped to the image's range."""
    return change_light(image, lambda light: random.poisson(light * photons).astype(np.float32) / np.float32(photons))
