"""The step ``point_stride``: fewer points, evenly."""

from __future__ import annotations

from typing import ClassVar

from slamhive.bags.variants.step import Array, Message, Operation, Step, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.bags.variants.steps.points import unorganised
from slamhive.domain.sensors import Sensor, SensorKind


class PointStride(Step):
    """Keep every N-th point in the order in which the scan is stored.

    Scans stored column by column lose whole beams if N and their number have a common factor: there, ``point_beams``
    says what is meant.
    """

    kind: ClassVar[str] = "point_stride"

    every: int = option("Keep one point of so many.", ge=1, le=10_000)

    def applies_to(self, sensor: Sensor) -> bool:
        """LiDARs."""
        return sensor.kind is SensorKind.LIDAR

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """Every point."""
        return self.every == 1

    def calibrate(self, sensor: Sensor) -> Sensor:
        """A list of points in place of an image of ranges."""
        return unorganised(sensor)

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all LiDARs alike
        """A slice of every scan."""

        def thin(points: Array, _message: Message) -> Array:
            return points[:: self.every].copy()

        return Operation(transform=thin)
