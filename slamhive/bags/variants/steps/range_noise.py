"""The fault ``range_noise``: a LiDAR that measures distances less well."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, SeededStep, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.bags.variants.steps.points import moved, ranges_m
from slamhive.domain.sensors import Sensor, SensorKind


class RangeNoise(SeededStep):
    """Gaussian noise along the ray of each point."""

    kind: ClassVar[str] = "range_noise"

    sigma_m: float = option("Standard deviation of a distance.", unit="m", ge=0, le=10)

    def applies_to(self, sensor: Sensor) -> bool:
        """LiDARs."""
        return sensor.kind is SensorKind.LIDAR

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """No noise."""
        return self.sigma_m == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all LiDARs alike
        """Noise on every scan."""
        return Operation(transform=self._degrade)

    def _degrade(self, points: Array, message: Message) -> Array:
        return add_range_noise(points, self.sigma_m, message.random())


def add_range_noise(points: Array, sigma_m: float, random: np.random.Generator) -> Array:
    """``points`` moved along their rays; none gets behind the sensor, and what has no distance stays."""
    distances = ranges_m(points)
    noisy = np.maximum(distances + sigma_m * random.standard_normal(len(points)), 0.0)
    measured = np.isfinite(distances) & (distances > 0)
    return moved(points, np.divide(noisy, distances, out=np.ones(len(points)), where=measured))
