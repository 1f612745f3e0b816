"""The fault ``imu_bias``: an IMU that measures past the truth, steadily or drifting."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.variants.step import Array, Message, Operation, SeededStep, Step, Stream, option


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


# The fault ``imu_noise``: a noisier IMU.


class AddedImuNoise(SeededStep):
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


# The fault ``imu_saturation``: an IMU whose range is too small for the motion.


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
