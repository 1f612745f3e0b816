"""The fault ``imu_saturation``: an IMU whose range is too small for the motion."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, Step, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor, SensorKind


class ImuSaturation(Step):
    """Each axis clipped at the end of the range."""

    kind: ClassVar[str] = "imu_saturation"

    gyroscope: float | None = option("Largest angular rate of an axis.", unit="rad/s", default=None, gt=0, le=1000)
    accelerometer: float | None = option(
        "Largest specific force along an axis; at rest one of them feels 9.81.",
        unit="m/s²",
        default=None,
        gt=0,
        le=10_000,
    )

    def applies_to(self, sensor: Sensor) -> bool:
        """IMUs."""
        return sensor.kind is SensorKind.IMU

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """No end of the range is given."""
        return self.gyroscope is None and self.accelerometer is None

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all IMUs alike
        """Every sample clipped."""
        ends = [np.inf if end is None else end for end in (self.gyroscope, self.accelerometer)]
        limits = np.repeat(ends, 3)

        def degrade(sample: Array, _message: Message) -> Array:
            return np.clip(sample, -limits, limits)

        return Operation(transform=degrade)
