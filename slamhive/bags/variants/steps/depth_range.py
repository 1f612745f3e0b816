"""The step ``depth_range``: a depth camera that sees less far, or not as near."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, Step, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import InvalidInput


class DepthRange(Step):
    """Pixels outside two depths become 0, "no value"."""

    kind: ClassVar[str] = "depth_range"

    minimum_m: float = option("Nearer pixels have no value.", unit="m", default=0.0, ge=0, le=10_000)
    maximum_m: float | None = option("Farther pixels have no value.", unit="m", default=None, gt=0, le=10_000)

    def applies_to(self, sensor: Sensor) -> bool:
        """Depth images."""
        return sensor.kind is SensorKind.DEPTH

    def check(self, sensor: Sensor) -> None:
        """Refuse limits between which nothing lies."""
        if self.maximum_m is not None and self.maximum_m <= self.minimum_m:
            raise InvalidInput(
                f"step depth_range: nothing of {sensor.name} lies between {self.minimum_m:g} and {self.maximum_m:g} m",
                "maximum_m must be above minimum_m",
            )

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """No limits."""
        return self.minimum_m == 0 and self.maximum_m is None

    def operation(self, stream: Stream) -> Operation:
        """A threshold on every image."""
        units_per_m = float(stream.sensor.calibration["units_per_m"])  # type: ignore[arg-type]
        lowest = self.minimum_m * units_per_m
        highest = np.inf if self.maximum_m is None else self.maximum_m * units_per_m

        def cut(depth: Array, _message: Message) -> Array:
            return np.where((depth >= lowest) & (depth <= highest), depth, np.zeros((), depth.dtype))

        return Operation(transform=cut)
