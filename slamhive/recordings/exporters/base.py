"""The seam of exports, and how exporters read the messages of sensors for folders of images and text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from rosbags.highlevel import AnyReader

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import IDENTITY4, Matrix4, Sensor
from slamhive.recordings.geometry import Array, quaternions_from_rotations
from slamhive.recordings.reader import decode, inspect_bag, messages, open_bag
from slamhive.recordings.staging import Pending, Progress, Ready, in_order, one_thread_in_opencv
from slamhive.recordings.variants.payloads import CODECS, COMPRESSED_IMAGE, IMAGE, IMU, POINTS
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.transforms import rotations_from_quats

ELSEWHERE = "export to ros1, ros2 or mcap"
"""The remedy where another format cannot hold something."""
_FROM_RGB = {"rgb8": cv2.COLOR_RGB2BGR, "rgb16": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGRA}
_FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_TYPES = {IMAGE, COMPRESSED_IMAGE, IMU, POINTS}
_PIXEL_BYTES = {"mono8": 1, "mono16": 2, "16UC1": 2, "32FC1": 4}
_COLOUR_BYTES = 3
_GEOMETRY_KEYS = ("width", "height", "fx", "fy", "cx", "cy")

Work = Callable[[], None]


class Sink(Protocol):
    """Takes the messages of one sensor."""

    def take(self, timestamp_ns: int, message: Any) -> Work | None:
        """Write the next message; what may wait for a thread is returned."""
        ...


@dataclass(eq=False)
class ImageSink:
    """Images as PNG files, pixel for pixel.

    ``name`` makes the file name from the timestamp and the number of the image, from 0.
    """

    sensor: Sensor
    folder: Path
    name: Callable[[int, int], str]

    def __post_init__(self) -> None:
        self._entries: list[tuple[int, str]] = []
        self.folder.mkdir(parents=True)

    def take(self, timestamp_ns: int, message: Any) -> Work:
        """Write an image, in a thread."""
        file = self.name(timestamp_ns, len(self._entries))
        self._entries.append((timestamp_ns, file))
        return partial(_write_png, self.folder / file, message, self.sensor.topic)

    @property
    def timestamps_ns(self) -> list[int]:
        """Of the images, in the order of the recording."""
        return [timestamp_ns for timestamp_ns, _ in self._entries]

    @property
    def entries(self) -> list[tuple[int, str]]:
        """Timestamps (ns) and file names, by timestamp: messages need not arrive in that order."""
        return sorted(self._entries)


@dataclass(eq=False)
class ImuSink:
    """IMU samples as lines ``timestamp [ns], angular rate (3) [rad/s], specific force (3) [m/s²]``."""

    path: Path
    header: str

    def __post_init__(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = self.path.open("w", encoding="ascii")
        self._stream.write(self.header + "\n")

    def take(self, timestamp_ns: int, message: Any) -> None:
        """Write a line."""
        rate, force = message.angular_velocity, message.linear_acceleration
        values = (rate.x, rate.y, rate.z, force.x, force.y, force.z)
        self._stream.write(",".join([str(timestamp_ns), *(repr(float(value)) for value in values)]) + "\n")

    def close(self) -> None:
        """Write what is left."""
        self._stream.close()


def message_counts(dataset: Dataset) -> dict[str, int]:
    """The number of messages by name of sensor; raises InvalidInput if a sensor has none in the recording."""
    present = {topic.topic: topic for topic in inspect_bag(dataset.bag_path).topics}
    counts = {}
    for sensor in dataset.sensors:
        if sensor.topic not in present:
            raise InvalidInput(
                f"{dataset.bag} holds no topic {sensor.topic}, where {dataset.name} has its sensor {sensor.name}",
                f"it holds: {', '.join(sorted(present))}",
            )
        counts[sensor.name] = present[sensor.topic].count
    return counts


def export_frames(dataset: Dataset, sinks: Mapping[str, Sink], progress: Progress) -> None:
    """Give all messages of the sensors in ``sinks`` to them, in order of time; raises InvalidInput."""
    topics = {dataset.sensor(name).topic: sink for name, sink in sinks.items()}
    with open_bag(dataset.bag_path) as reader, one_thread_in_opencv():
        for _ in in_order(_tasks(dataset.bag_path, reader, topics, progress)):
            pass


def _tasks(
    path: Path, reader: AnyReader, topics: Mapping[str, Sink], progress: Progress
) -> Iterator[Ready[None] | Pending[None]]:
    total = sum(entry.msgcount for entry in reader.connections if entry.topic in topics)
    for number, (connection, _, raw) in enumerate(messages(reader, path, list(topics)), start=1):
        if connection.msgtype not in _TYPES:
            raise InvalidInput(f"{connection.topic} carries {connection.msgtype}, which cannot be exported", ELSEWHERE)
        message = decode(reader, path, connection, raw)
        stamp = message.header.stamp
        work = topics[connection.topic].take(stamp.sec * 1_000_000_000 + stamp.nanosec, message)
        if work is not None:
            yield Pending(work, len(raw))
        progress(number / total, f"writing message {number} of {total}")


def left_out(dataset: Dataset, kept: Iterable[Sensor]) -> tuple[str, ...]:
    """The sensors of ``dataset`` that are not ``kept`` and its other content that only recordings hold, in words."""
    names = {sensor.name for sensor in kept}
    found = [f"{sensor.name} ({sensor.kind.value})" for sensor in dataset.sensors if sensor.name not in names]
    found += ["the reference map"] if dataset.reference_map is not None else []
    found += ["the relations"] if dataset.relations is not None else []
    return tuple(found)


def image_bytes(sensor: Sensor) -> int:
    """The size of one image without compression."""
    seen = CameraIntrinsics.of(sensor)
    return seen.width * seen.height * _PIXEL_BYTES.get(str(sensor.calibration.get("encoding")), _COLOUR_BYTES)


def share_pixels(depth: Sensor, camera: Sensor) -> bool:
    """Tell if the images of both have the same geometry, as formats with one calibration for both require."""
    values = [[sensor.calibration[key] for key in _GEOMETRY_KEYS] for sensor in (depth, camera)]
    return values[0] == values[1] and depth.T_body_sensor == camera.T_body_sensor


def _write_png(path: Path, message: Any, topic: str) -> None:
    kind = message.__msgtype__
    pixels = CODECS[kind].decode(message, topic)
    code = _FROM_RGB.get(getattr(message, "encoding", ""))
    if code is not None:
        pixels = cv2.cvtColor(pixels, code)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InvalidInput(f"{topic}: images of {pixels.dtype} cannot be written as PNG", ELSEWHERE)
    _, data = cv2.imencode(".png", pixels, _FAST_PNG)
    try:
        with path.open("xb") as stream:
            stream.write(data.tobytes())
    except FileExistsError:
        raise InvalidInput(f"{topic}: two images have the timestamp of {path.name}", ELSEWHERE) from None


# The ground truth of a dataset as other formats write it: times in ns, poses of the sensor they ask for.


_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, eq=False)
class ExportedTruth:
    """Poses in the world: times (n,) int64 ns, positions (n, 3), unit quaternions (n, 4) x y z w."""

    times_ns: Array
    positions_m: Array
    quats_xyzw: Array

    def of_sensor(self, T_body_sensor: Matrix4) -> ExportedTruth:
        """The poses of a sensor, where these are the body's."""
        if T_body_sensor == IDENTITY4:
            return self
        T = np.array(T_body_sensor).reshape(4, 4)
        R = rotations_from_quats(self.quats_xyzw)
        positions_m = self.positions_m + R @ T[:3, 3]
        return ExportedTruth(self.times_ns, positions_m, quaternions_from_rotations(R @ T[:3, :3]))


def read_truth(dataset: Dataset) -> ExportedTruth | None:
    """The full poses of ``dataset``; None if it has no ground truth, or positions only.

    Times are read as decimal numbers: a double has no room for nanoseconds of our century.
    """
    truth, path = dataset.groundtruth, dataset.groundtruth_path
    if truth is None or path is None or truth.positions_only:
        return None
    poses = read_tum(path)
    lines = (line.split() for line in path.read_text(encoding="utf-8").replace(",", " ").splitlines())
    words = [line[0] for line in lines if line and not line[0].startswith("#")]
    times_ns = np.array([round(Decimal(word) * _NS_PER_S) for word in words], dtype=np.int64)
    return ExportedTruth(times_ns, poses.positions_m, poses.quats_xyzw)


def truth_left_out(dataset: Dataset) -> tuple[str, ...]:
    """The ground truth, in words, if it has positions only: formats of poses cannot hold it."""
    truth = dataset.groundtruth
    return ("the ground truth (positions only)",) if truth is not None and truth.positions_only else ()


# Numbers and lists for the YAML files of other formats, which are written line by line as their tools write them.


def number(value: Any) -> str:
    """A number that YAML 1.1 reads as one too: an exponent needs a decimal point there."""
    text = repr(float(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def numbers(values: Iterable[Any]) -> str:
    """A list of numbers in one line."""
    return f"[{', '.join(number(value) for value in values)}]"


# The seam of exports: what an exporter says before anything is written, and what it then writes.


@dataclass(frozen=True, eq=False)
class ExportPlan:
    """Plan of an export.

    Attributes:
        write: Writes into an empty folder; raises InvalidInput for a damaged recording, OSError for a full disk.
        needed_bytes: The size of the result, estimated from above.
        left_out: What the format cannot hold, one phrase each: ``depth0 (depth)``. Such an export must be asked for.
        notes: What users of the result should know, one sentence each.
    """

    write: Callable[[Path, Progress], None]
    needed_bytes: int
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@runtime_checkable
class Exporter(Protocol):
    """Turns datasets into folders of one format."""

    def plan(self, dataset: Dataset) -> ExportPlan:
        """Plan the export of ``dataset``; raises InvalidInput if the format is for something else."""
        ...
