"""The fault ``gamma``: a tone curve that lifts or drowns the shadows, steadily or swinging."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, SeededStep, Stream
from slamhive.bags.variants.steps.images import lookup
from slamhive.bags.variants.steps.options import option
from slamhive.bags.variants.steps.swing import Swing
from slamhive.domain.sensors import Sensor, SensorKind


class Gamma(SeededStep):
    """Pixel values (0..1) to the power of ``gamma``: below 1 brightens the shadows, above 1 darkens them."""

    kind: ClassVar[str] = "gamma"

    gamma: float = option("The exponent.", default=1.0, ge=0.1, le=10)
    swing: float = option("How far its logarithm to base 2 swings.", unit="octaves", default=0.0, ge=0, le=3)
    period_s: float = option("Duration of one swing.", unit="s", default=4.0, ge=0.1, le=3600)

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """The exponent 1 at any time."""
        return self.gamma == 1 and self.swing == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """A curve on every image."""
        swing = Swing(float(np.log2(self.gamma)), self.swing, self.period_s, self.seed)

        def degrade(image: Array, message: Message) -> Array:
            return bend(image, 2.0 ** swing.at(message.stamp_ns))

        return Operation(transform=degrade)


def bend(image: Array, gamma: float) -> Array:
    """``image`` with each pixel value (0..1) to the power of ``gamma``."""
    return lookup(image, lambda light: np.power(light, gamma))
