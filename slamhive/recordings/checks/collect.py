"""The one pass over a recording that collects evidence for all checks."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.checks.collect_images import CameraRig, DepthCollector, ImageCollector, ImageWork
from slamhive.recordings.checks.collect_sweeps import LaserCollector, SweepCollector
from slamhive.recordings.checks.evidence import Array, DatasetEvidence, StreamEvidence
from slamhive.recordings.checks.truth import read_truth
from slamhive.recordings.reader import decode, messages, open_bag
from slamhive.recordings.staging import Progress
from slamhive.runtime.messages import COMPRESSED_IMAGE, IMAGE, IMU, LASER_SCAN, ODOMETRY, POINTS

NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
MOST_TIMES = 5_000_000
"""Messages of one sensor whose timestamps are kept: 80 MB, seven hours of an IMU at 200 Hz."""
MOST_SAMPLES = 2_000_000
"""IMU samples whose values are kept: 48 MB, 2.8 hours at 200 Hz."""
EXPECTED_TYPES: Mapping[SensorKind, tuple[str, ...]] = {
    SensorKind.CAMERA: (IMAGE, COMPRESSED_IMAGE),
    SensorKind.DEPTH: (IMAGE, COMPRESSED_IMAGE),
    SensorKind.IMU: (IMU,),
    SensorKind.LIDAR: (POINTS,),
    SensorKind.LASER: (LASER_SCAN,),
    SensorKind.ODOMETRY: (ODOMETRY,),
    SensorKind.GNSS: (NAV_SAT_FIX,),
}
_STAMPED = tuple(kind for kinds in EXPECTED_TYPES.values() for kind in kinds)
"""Types with a header, whose timestamps are collected even if a sensor of another kind should have them."""
_REPORT_EVERY = 500


class Content(Protocol):
    """Collects what messages of one kind of sensor hold."""

    def add(self, index: int, header_ns: int, message: Any) -> None:
        """Take message ``index``."""

    def finish(self) -> dict[str, Any]:
        """The fields of :class:`Stream` that follow from it."""


class _ImuContent:
    def __init__(self) -> None:
        self._rows = array("f")

    def add(self, index: int, header_ns: int, message: Any) -> None:  # noqa: ARG002 - the values alone count
        rate, force = message.angular_velocity, message.linear_acceleration
        if index < MOST_SAMPLES:
            self._rows.extend((rate.x, rate.y, rate.z, force.x, force.y, force.z))

    def finish(self) -> dict[str, Any]:
        return {"imu": np.array(self._rows, dtype=np.float32).reshape(-1, 6)}


@dataclass(eq=False)
class _Collector:
    """Timestamps of one stream, and its content if its type is read."""

    sensor: Sensor
    kind: str
    content: Content | None
    header_ns: array[int]
    received_ns: array[int]
    total: int = 0

    def add(self, received_ns: int, message: Any) -> None:
        stamp = message.header.stamp
        header_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
        if self.total < MOST_TIMES:
            self.header_ns.append(header_ns)
            self.received_ns.append(received_ns)
        if self.content is not None:
            self.content.add(self.total, header_ns, message)
        self.total += 1

    def stream(self) -> StreamEvidence:
        fields = {} if self.content is None else self.content.finish()
        return StreamEvidence(
            self.sensor, self.kind, _times(self.header_ns), _times(self.received_ns), self.total, **fields
        )


def _times(values: array[int]) -> Array:
    return np.array(values, dtype=np.int64)


def collect(dataset: Dataset, progress: Progress) -> DatasetEvidence:
    """Read the recording once; raises InvalidInput if it is damaged."""
    path = dataset.bag_path
    with open_bag(path) as reader, ImageWork() as background:
        topics = {name: topic.msgtype or "various" for name, topic in reader.topics.items()}
        counts = {name: topic.msgcount for name, topic in reader.topics.items()}
        rig = CameraRig(dataset, {sensor.name: counts.get(sensor.topic, 0) for sensor in dataset.sensors}, background)
        # Only topics of a type that has a header: the others have no time of measurement.
        collectors = {}
        for sensor in dataset.sensors:
            kind = topics.get(sensor.topic)
            if kind is None or kind not in _STAMPED:
                continue
            make = _CONTENTS.get(sensor.kind) if kind in EXPECTED_TYPES[sensor.kind] else None
            content = None if make is None else make(sensor, counts[sensor.topic], rig)
            collectors[sensor.topic] = _Collector(sensor, kind, content, array("q"), array("q"))
        start_ns, end_ns = int(reader.start_time), max(int(reader.end_time) - 1, int(reader.start_time))
        total = sum(counts[topic] for topic in collectors)
        for number, (connection, received_ns, raw) in enumerate(messages(reader, path, list(collectors))):
            collectors[connection.topic].add(received_ns, decode(reader, path, connection, raw))
            if number % _REPORT_EVERY == 0:
                progress(number / total, "reading the recording")
        streams = {collector.sensor.name: collector.stream() for collector in collectors.values()}
    truth, problem = read_truth(dataset)
    return DatasetEvidence(dataset, start_ns, end_ns, streams, topics, truth, problem)


_CONTENTS: dict[SensorKind, Callable[[Sensor, int, CameraRig], Content]] = {
    SensorKind.CAMERA: ImageCollector,
    SensorKind.DEPTH: DepthCollector,
    SensorKind.IMU: lambda _sensor, _count, _rig: _ImuContent(),
    SensorKind.LIDAR: lambda sensor, count, _rig: SweepCollector(sensor, count),
    SensorKind.LASER: lambda _sensor, count, _rig: LaserCollector(count),
}
