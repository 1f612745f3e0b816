"""The fault ``imu_bias``: an IMU that measures past the truth, steadily or drifting."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, SeededStep, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor, SensorKind


class ImuBias(SeededStep):
    """A constant vector of the given length in a seeded direction, and a random walk that starts at 0."""

    kind: ClassVar[str] = "imu_bias"

    gyroscope: float = option("Length of the constant bias.", unit="rad/s", default=0.0, ge=0, le=10)
    accelerometer: float = option("Length of the constant bias.", unit="m/s²", default=0.0, ge=0, le=100)
    gyroscope_walk: float = option("Drift of the bias.", unit="rad/s²/√Hz", default=0.0, ge=0, le=1)
    accelerometer_walk: float = option("Drift of the bias.", unit="m/s³/√Hz", default=0.0, ge=0, le=10)

    def applies_to(self, sensor: Sensor) -> bool:
        """IMUs."""
        return sensor.kind is SensorKind.IMU

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """No bias."""
        return not (self.gyroscope or self.accelerometer or self.gyroscope_walk or self.accelerometer_walk)

    def operation(self, stream: Stream) -> Operation:
        """A bias on every sample."""
        random = stream.random()
        directions = random.standard_normal((2, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        constant = (directions * [[self.gyroscope], [self.accelerometer]]).reshape(6)
        step_sigmas = np.repeat([self.gyroscope_walk, self.accelerometer_walk], 3) / np.sqrt(stream.sensor.rate_hz)
        walk = np.cumsum(random.standard_normal((stream.count, 6)) * step_sigmas, axis=0)

        def degrade(sample: Array, message: Message) -> Array:
            biased: Array = sample + constant + walk[message.index]
            return biased

        return Operation(transform=degrade)
