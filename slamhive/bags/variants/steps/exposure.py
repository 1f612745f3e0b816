"""The fault ``exposure``: images too bright or too dark, steadily or swinging."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, SeededStep, Stream
from slamhive.bags.variants.steps.images import lookup
from slamhive.bags.variants.steps.options import option
from slamhive.bags.variants.steps.swing import Swing
from slamhive.domain.sensors import Sensor, SensorKind


class Exposure(SeededStep):
    """Pixel values times 2^stops, clipped at white: what a different exposure time makes of a linear sensor."""

    kind: ClassVar[str] = "exposure"

    stops: float = option("Change of exposure; 1 doubles the brightness.", unit="stops", default=0.0, ge=-8, le=8)
    swing_stops: float = option("How far it swings around that.", unit="stops", default=0.0, ge=0, le=8)
    period_s: float = option("Duration of one swing.", unit="s", default=4.0, ge=0.1, le=3600)

    def applies_to(self, sensor: Sensor) -> bool:
        """Cameras."""
        return sensor.kind is SensorKind.CAMERA

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """No change at any time."""
        return self.stops == 0 and self.swing_stops == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all cameras alike
        """A factor on every image."""
        swing = Swing(self.stops, self.swing_stops, self.period_s, self.seed)

        def degrade(image: Array, message: Message) -> Array:
            return expose(image, swing.at(message.stamp_ns))

        return Operation(transform=degrade)


def expose(image: Array, stops: float) -> Array:
    """``image`` times 2^``stops``, clipped to its range."""
    factor = np.float64(2.0**stops)
    return lookup(image, lambda light: light * factor)
