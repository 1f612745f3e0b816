"""The fault ``imu_noise``: a noisier IMU."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, SeededStep, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor, SensorKind


class ImuNoise(SeededStep):
    """White noise in addition to the sensor's own. A density d makes d * sqrt(rate) on each sample."""

    kind: ClassVar[str] = "imu_noise"

    gyroscope: float = option("Noise density of the angular rate.", unit="rad/s/√Hz", default=0.0, ge=0, le=10)
    accelerometer: float = option("Noise density of the specific force.", unit="m/s²/√Hz", default=0.0, ge=0, le=100)

    def applies_to(self, sensor: Sensor) -> bool:
        """IMUs."""
        return sensor.kind is SensorKind.IMU

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """No noise."""
        return self.gyroscope == 0 and self.accelerometer == 0

    def operation(self, stream: Stream) -> Operation:
        """Noise on every sample."""
        sigmas = np.repeat([self.gyroscope, self.accelerometer], 3) * np.sqrt(stream.sensor.rate_hz)

        def degrade(sample: Array, message: Message) -> Array:
            noisy: Array = sample + sigmas * message.random().standard_normal(6)
            return noisy

        return Operation(transform=degrade)
