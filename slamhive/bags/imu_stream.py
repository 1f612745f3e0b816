"""Streams of IMU samples."""

from __future__ import annotations

from slamhive.bags.bag_writer import BagWriter
from slamhive.bags.geometry import Array
from slamhive.bags.importing import Stream
from slamhive.domain.sensors import Sensor

_IMU_BYTES = 400


def imu_stream(sensor: Sensor, times_ns: Array, samples: Array) -> Stream:
    """The messages of an IMU; ``samples`` (n, 6) are angular rates in rad/s and accelerations in m/s²."""

    def write(bag: BagWriter, index: int) -> None:
        bag.imu(sensor, int(times_ns[index]), samples[index, :3], samples[index, 3:])

    return Stream(sensor, times_ns, write, _IMU_BYTES)
