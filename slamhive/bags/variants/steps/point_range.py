"""The step ``point_range``: a LiDAR that sees less far, or not as near."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from slamhive.bags.variants.step import Array, Message, Operation, Step, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.bags.variants.steps.points import ranges_m, unorganised
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import InvalidInput


class PointRange(Step):
    """Keep the points between two distances; the calibration states the new limits."""

    kind: ClassVar[str] = "point_range"

    minimum_m: float = option("Nearer points are left out.", unit="m", default=0.0, ge=0, le=10_000)
    maximum_m: float | None = option("Farther points are left out.", unit="m", default=None, gt=0, le=10_000)

    def applies_to(self, sensor: Sensor) -> bool:
        """LiDARs."""
        return sensor.kind is SensorKind.LIDAR

    def check(self, sensor: Sensor) -> None:
        """Refuse limits between which nothing lies."""
        if self.maximum_m is not None and self.maximum_m <= self.minimum_m:
            raise InvalidInput(
                f"step point_range: nothing of {sensor.name} lies between {self.minimum_m:g} and {self.maximum_m:g} m",
                "maximum_m must be above minimum_m",
            )

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """No limits."""
        return self.minimum_m == 0 and self.maximum_m is None

    def calibrate(self, sensor: Sensor) -> Sensor:
        """The narrower of the sensor's own limits and these."""
        calibration = dict(sensor.calibration)
        if self.minimum_m > 0:
            calibration["minimum_range_m"] = max(self.minimum_m, _number(calibration.get("minimum_range_m"), 0.0))
        if self.maximum_m is not None:
            own_m = _number(calibration.get("maximum_range_m"), self.maximum_m)
            calibration["maximum_range_m"] = min(self.maximum_m, own_m)
        return unorganised(replace(sensor, calibration=calibration))

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all LiDARs alike
        """A filter on the points of every scan."""
        maximum_m = float("inf") if self.maximum_m is None else self.maximum_m

        def cut(points: Array, _message: Message) -> Array:
            distances = ranges_m(points)
            kept: Array = points[(distances >= self.minimum_m) & (distances <= maximum_m)]
            return kept

        return Operation(transform=cut)


def _number(value: object, otherwise: float) -> float:
    return float(value) if isinstance(value, int | float) else otherwise
