"""The one pass over a recording that collects evidence for all checks."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import LidarLayout
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.checks.collect_images import CameraRig, DepthCollector, ImageCollector, ImageWork
from slamhive.recordings.checks.evidence import Array, DatasetEvidence, StreamEvidence, Sweeps
from slamhive.recordings.checks.truth import read_truth
from slamhive.recordings.reader import decode, messages, open_bag
from slamhive.recordings.staging import Progress
from slamhive.runtime.messages import COMPRESSED_IMAGE, IMAGE, IMU, LASER_SCAN, ODOMETRY, POINTS, stamp_ns, to_points
from slamhive.runtime.point_times import TimeReference

FEWEST_PLACES, MOST_PLACES, SWEEPS_PER_PLACE = 4, 10, 40
"""At a place three sweeps are read whole (2 ms each): two neighbours, and one some time later."""
LATER_S = 0.5
"""Time between sweeps that are registered: most bodies move further in it than a sweep is distorted."""
POINTS_SAMPLED = 200
"""Points of every sweep whose range is looked at."""
MOST_RANGES = 200_000
CLOUD_POINTS = 3000
_SEAM_SHARE = 0.006
"""The first and the last 2 degrees of a sweep lie at the seam."""
_SEAM_CELLS = 64
NEARLY_ZERO_M = 1e-6
_COLUMNS = 60
_POINT_TYPES = {7: "f4", 8: "f8"}


class SweepCollector:
    """The sweeps of one LiDAR."""

    def __init__(self, sensor: Sensor, count: int) -> None:
        self._layout, self._problem = _layout(sensor)
        later = max(1, round(LATER_S * sensor.rate_hz))
        number = min(MOST_PLACES, max(FEWEST_PLACES, count // SWEEPS_PER_PLACE))
        starts = np.linspace(0, max(0, count - 1 - later), number).astype(int)
        self._whole = {int(start) + step for start in starts for step in (0, 1, later)}
        self._ranges_each = max(20, min(POINTS_SAMPLED, MOST_RANGES // max(1, count)))
        self._counts = array("d")
        self._ranges = array("f")
        self._zeros, self._looked_at = 0, 0
        self._fields: tuple[str, ...] = ()
        self._times_s: list[tuple[float, float]] = []
        self._turns_rad: list[float] = []
        self._seams_m: list[tuple[float, float]] = []
        self._clouds: list[tuple[int, Array]] = []
        self._previous: tuple[int, _Ends] | None = None

    def add(self, index: int, header_ns: int, message: Any) -> None:  # noqa: ARG002 - the points alone count
        """Take one sweep."""
        self._fields = self._fields or tuple(field.name for field in message.fields)
        sample = _sampled(message, self._ranges_each)
        ranges = np.sqrt((sample**2).sum(axis=1))
        ranges = ranges[np.isfinite(ranges)]
        apart = ranges[ranges > NEARLY_ZERO_M]
        self._counts.append(int(message.width) * int(message.height) * len(ranges) / max(1, len(sample)))
        self._looked_at, self._zeros = self._looked_at + len(sample), self._zeros + len(ranges) - len(apart)
        self._ranges.frombytes(apart.astype(np.float32).tobytes())
        if index in self._whole:
            try:
                cloud = to_points(message)
            except InvalidInput:
                return
            near = (cloud.points_m**2).sum(axis=1) > NEARLY_ZERO_M**2
            points = cloud.points_m[near]
            if len(points) == 0:
                return
            self._clouds.append((index, points[:: max(1, len(points) // CLOUD_POINTS)].astype(np.float32)))
            times = None if self._layout is None else self._layout.times
            if times is not None and times.field in cloud.fields:
                values = cloud.fields[times.field][near].astype(np.float64) * times.unit.seconds
                # Times of points are to count from the start of the sweep.
                timestamp_s, zero_s = stamp_ns(message) * 1e-9, 0.0
                if times.reference is not TimeReference.SWEEP_START:
                    zero_s = timestamp_s if times.reference is TimeReference.TIMESTAMP else 0.0
                    zero_s -= times.start_s(timestamp_s)
                times_s = values + zero_s
                if (np.diff(times_s) < 0).any():
                    order = np.argsort(times_s, kind="stable")
                    times_s, points = times_s[order], points[order]
                self._times_s.append((float(times_s[0]), float(times_s[-1])))
                self._turns_rad.append(_turn_rad(points, times_s))
                ends = _Ends(points)
                if self._previous is not None and self._previous[0] == index - 1:
                    before = self._previous[1]
                    self._seams_m.append((apart_m(before.last, ends.first), apart_m(before.first, ends.last)))
                self._previous = (index, ends)

    def finish(self) -> dict[str, Any]:
        """The sweeps."""
        sweeps = Sweeps(
            counts=np.array(self._counts),
            fields=self._fields,
            ranges_m=np.array(self._ranges, dtype=np.float32),
            zero_share=self._zeros / max(1, self._looked_at),
            times_s=np.array(self._times_s).reshape(-1, 2),
            layout_problem=self._problem,
            turns_rad=np.array(self._turns_rad),
            seams_m=np.array(self._seams_m).reshape(-1, 2),
            clouds=tuple(self._clouds),
        )
        return {"sweeps": sweeps}


class LaserCollector:
    """The scans of a laser that measures in one plane."""

    def __init__(self, count: int) -> None:
        self._ranges_each = max(10, min(POINTS_SAMPLED, MOST_RANGES // max(1, count)))
        self._counts = array("d")
        self._ranges = array("f")

    def add(self, index: int, header_ns: int, message: Any) -> None:  # noqa: ARG002 - the ranges alone count
        """Take one scan; ranges beyond what the message itself says to be valid are no echo."""
        ranges = np.asarray(message.ranges, dtype=np.float32)
        echoes = ranges[np.isfinite(ranges) & (ranges > NEARLY_ZERO_M) & (ranges < float(message.range_max))]
        self._counts.append(len(echoes))
        self._ranges.frombytes(echoes[:: max(1, len(echoes) // self._ranges_each)].tobytes())

    def finish(self) -> dict[str, Any]:
        """The scans, as sweeps without times of points."""
        nothing = np.zeros((0, 2))
        ranges_m = np.array(self._ranges, dtype=np.float32)
        return {"sweeps": Sweeps(np.array(self._counts), (), ranges_m, 0.0, nothing, nothing[:, 0], nothing)}


class _Ends:
    """Ranges by direction of the first and the last points in time of a sweep."""

    def __init__(self, points: Array) -> None:
        number = max(1, int(_SEAM_SHARE * len(points)))
        self.first, self.last = _by_elevation(points[:number]), _by_elevation(points[-number:])


def _by_elevation(points: Array) -> Array:
    """Median range in each of some elevations, NaN where there is no point."""
    flat = np.hypot(points[:, 0], points[:, 1])
    cells = ((np.arctan2(points[:, 2], flat) / np.pi + 0.5) * _SEAM_CELLS * 2).astype(int)
    ranges = np.linalg.norm(points, axis=1)
    medians = np.full(_SEAM_CELLS * 2 + 1, np.nan)
    # One sort for all cells: the median of each is in the middle of its run, or between the two in the middle.
    order = np.lexsort((ranges, cells))
    found, starts, counts = np.unique(cells[order], return_index=True, return_counts=True)
    ranges = ranges[order]
    medians[found] = (ranges[starts + (counts - 1) // 2] + ranges[starts + counts // 2]) / 2
    return medians


def apart_m(first: Array, second: Array) -> float:
    """Median difference of ranges in the directions that both have; NaN if there are few."""
    both = np.isfinite(first) & np.isfinite(second)
    return float(np.median(np.abs(first[both] - second[both]))) if both.sum() >= 4 else np.nan


def _layout(sensor: Sensor) -> tuple[LidarLayout | None, str | None]:
    """The declared layout, or why it makes no sense."""
    try:
        return LidarLayout.of(sensor), None
    except InvalidInput as error:
        return None, str(error)


def _turn_rad(points: Array, times: Array) -> float:
    """Sum of the angles from column to column, seen from above, counter-clockwise positive; NaN if times are equal."""
    if times[0] == times[-1]:
        return np.nan
    cuts = np.unique(np.searchsorted(times, np.linspace(times[0], times[-1], _COLUMNS + 1))[:-1])
    directions = points[:, 0] + 1j * points[:, 1]
    sums = np.add.reduceat(directions / np.maximum(np.abs(directions), NEARLY_ZERO_M), cuts)
    return float(np.angle(sums[1:] * np.conj(sums[:-1])).sum())


def _sampled(message: Any, number: int) -> Array:
    """About ``number`` points (n, 3) of a message; empty if it has none or no x, y, z of a usual type."""
    places = {field.name: field for field in message.fields if field.name in {"x", "y", "z"}}
    total = int(message.width) * int(message.height)
    nothing = np.zeros((0, 3))
    data = np.asarray(message.data, dtype=np.uint8)
    if len(places) < 3 or total == 0 or data.size < total * message.point_step:
        return nothing
    if any(place.datatype not in _POINT_TYPES for place in places.values()):
        return nothing
    ends = [place.offset + np.dtype(_POINT_TYPES[place.datatype]).itemsize for place in places.values()]
    if max(ends) > message.point_step:
        return nothing
    order = ">" if message.is_bigendian else "<"
    layout = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": [order + _POINT_TYPES[places[axis].datatype] for axis in "xyz"],
            "offsets": [places[axis].offset for axis in "xyz"],
            "itemsize": message.point_step,
        }
    )
    table = data[: total * message.point_step].view(layout)[:: max(1, total // number)]
    return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)


# The one pass over a recording that collects evidence for all checks.


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
