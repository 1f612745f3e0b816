"""A pre-processing step: an IMU whose axes do not answer alike.

`imu_scale` in an experiment, or `slamhive variants make DATASET --step 'imu_scale gyroscope=1.02'`, makes a variant of
a dataset. Copy this file and change the options and what happens to a message.
"""

from typing import ClassVar

from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.variants.step import Array, Message, Operation, Step, Stream, option


class ImuScale(Step):
    """Every sample times a factor, as an IMU with a wrong scale delivers it."""

    # Step is a frozen pydantic model. Its fields are the options. Its docstring is the help on pages.
    kind: ClassVar[str] = "imu_scale"  # the name of the entry point
    version: ClassVar[int] = 1  # raise it when the same options produce other bytes; cached variants are then replaced

    gyroscope: float = option("Factor of the angular rates.", unit="1", default=1.0, gt=0, le=10)
    accelerometer: float = option("Factor of the accelerations.", unit="1", default=1.0, gt=0, le=10)

    def applies_to(self, sensor: Sensor) -> bool:
        """Say which sensors the step can be used on."""
        return sensor.kind is SensorKind.IMU

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002
        """Say whether nothing changes; no copy of the recording is then made."""
        return self.gyroscope == self.accelerometer == 1.0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002
        """Say what happens to the messages of one topic.

        An IMU sample is an array of 6: angular rate in rad/s, specific force in m/s². Images and point clouds come as
        arrays too; docs in slamhive/recordings/variants/step.py. Transforms run in several threads: return a new
        array. For random numbers, subclass SeededStep and draw them from `message.random()`.
        """
        factors = [self.gyroscope] * 3 + [self.accelerometer] * 3

        def transform(sample: Array, message: Message) -> Array:  # noqa: ARG001
            scaled: Array = sample * factors
            return scaled

        return Operation(transform=transform)
