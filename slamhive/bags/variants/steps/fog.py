"""The fault ``fog``: far points are lost, and some of them come back from the fog itself."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, SeededStep, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.bags.variants.steps.points import moved, ranges_m, unorganised
from slamhive.domain.sensors import Sensor, SensorKind

_CONTRAST_AT_VISIBILITY = 0.05
"""The meteorological optical range is where 5 % of the light is left (WMO guide no. 8, chapter 9)."""


class Fog(SeededStep):
    """A point at distance r survives with the probability exp(-2 a r): its light goes there and back.

    a = -ln(0.05) / visibility (Koschmieder's law). Of the points lost, the share ``backscatter`` is seen where the fog
    threw the light back: at a distance drawn from the same law, before the surface.
    """

    kind: ClassVar[str] = "fog"

    visibility_m: float = option("Meteorological optical range; 50 m is dense fog.", unit="m", ge=1, le=100_000)
    backscatter: float = option("Share of the lost points that show up in the fog.", default=0.0, ge=0, le=1)

    def applies_to(self, sensor: Sensor) -> bool:
        """LiDARs."""
        return sensor.kind is SensorKind.LIDAR

    def calibrate(self, sensor: Sensor) -> Sensor:
        """A list of points in place of an image of ranges: what fog swallows is left out."""
        return unorganised(sensor)

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all LiDARs alike
        """Fog in every scan."""
        return Operation(transform=self._degrade)

    def _degrade(self, points: Array, message: Message) -> Array:
        return see_through_fog(points, self.visibility_m, self.backscatter, message.random())


def see_through_fog(points: Array, visibility_m: float, backscatter: float, random: np.random.Generator) -> Array:
    """What a LiDAR measures of ``points`` in fog; those that are not finite are left out."""
    attenuation = -2.0 * math.log(_CONTRAST_AT_VISIBILITY) / visibility_m
    distances = ranges_m(points)
    lost_at = random.exponential(1.0 / attenuation, len(points))
    thrown_back = random.random(len(points)) < backscatter
    survives = lost_at >= distances
    seen = np.isfinite(distances) & (survives | thrown_back)
    factors = np.divide(lost_at, distances, out=np.ones(len(points)), where=~survives & (distances > 0))
    kept: Array = moved(points, factors)[seen]
    return kept
