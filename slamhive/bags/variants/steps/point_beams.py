"""The step ``point_beams``: a LiDAR with fewer beams."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from slamhive.bags.variants.step import Array, Message, Operation, Step, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.bags.variants.steps.points import beam_numbers, ring_field, unorganised
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import InvalidInput


class PointBeams(Step):
    """Keep every N-th beam (0, N, 2N, ...) and number those left from 0, as a sensor with so many would."""

    kind: ClassVar[str] = "point_beams"

    every: int = option("Keep one beam of so many.", unit="beams", ge=1, le=256)

    def applies_to(self, sensor: Sensor) -> bool:
        """LiDARs."""
        return sensor.kind is SensorKind.LIDAR

    def check(self, sensor: Sensor) -> None:
        """Refuse a sensor whose number of beams is not known, and more than it has."""
        beams = _beams(sensor)
        if self.every > beams:
            raise InvalidInput(
                f"step point_beams: every {self.every} is more than the {beams} beams of {sensor.name}",
                f"use 1 to {beams}",
            )

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """Every beam."""
        return self.every == 1

    def calibrate(self, sensor: Sensor) -> Sensor:
        """As many beams as are left."""
        left = {**sensor.calibration, "beams": -(-_beams(sensor) // self.every)}
        return unorganised(replace(sensor, calibration=left))

    def operation(self, stream: Stream) -> Operation:
        """A filter on the points of every scan."""
        beams, ring = _beams(stream.sensor), ring_field(stream.sensor)

        def thin(points: Array, _message: Message) -> Array:
            numbers = beam_numbers(points, beams, ring)
            kept: Array = points[numbers % self.every == 0]
            if ring in (points.dtype.names or ()):
                kept[ring] //= self.every
            return kept

        return Operation(transform=thin)


def _beams(sensor: Sensor) -> int:
    beams = sensor.calibration.get("beams")
    if not isinstance(beams, int) or beams < 1:
        raise InvalidInput(
            f"step point_beams: dataset.yaml does not say how many beams {sensor.name} has", "add beams: N to it"
        )
    return beams
