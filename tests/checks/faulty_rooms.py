"""A short recording of the room, and copies of it with one fault each."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.domain.dataset import CheckReport, Dataset
from slamhive.domain.sensors import Sensor
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.checks.collect import collect
from slamhive.recordings.checks.registry import judge
from slamhive.recordings.reader import decode, messages, open_bag
from slamhive.recordings.room import RoomOptions, render_room
from slamhive.recordings.room.sensors import POINT_TYPE
from slamhive.trajectory.layout import read_tum
from tests.recordings.variant_bags import write_bag

Message = tuple[str, int, Any]
"""Topic, receive time in ns, content."""

CAM0, CAM1, DEPTH, IMU, LIDAR = "/cam0/image_raw", "/cam1/image_raw", "/depth0/image_raw", "/imu0", "/points"
SECONDS, WIDTH, HEIGHT, CAMERA_HZ = 4.0, 240, 180, 10.0


@dataclass(frozen=True, eq=False)
class Room:
    """A rendered room, with its messages and its ground truth (n, 8) in memory."""

    dataset: Dataset
    messages: list[Message]
    truth: Any

    def check(self, folder: Path, **changes: Any) -> CheckReport:
        """The report of this room with another ``recording``, ``truth`` or ``dataset``."""
        dataset: Dataset = changes.get("dataset", self.dataset)
        bag = self.dataset.bag_path
        if "recording" in changes:
            bag = folder / "faulty.bag"
            write_bag(bag, changes["recording"], chunk=800_000)
        (folder / dataset.bag).unlink(missing_ok=True)
        (folder / dataset.bag).symlink_to(bag)
        if changes.get("truth", self.truth) is not None:
            rows = changes.get("truth", self.truth)
            np.savetxt(folder / "groundtruth.txt", rows, fmt="%.9f")
        report = judge(collect(dataclasses.replace(dataset, folder=folder), lambda _fraction, _text: None))
        if "recording" in changes:
            bag.unlink()
        return report


def render(folder: Path) -> Room:
    """The room of the tests: 4 s, small images."""
    options = RoomOptions("room", SECONDS, width=WIDTH, height=HEIGHT, camera_rate_hz=CAMERA_HZ, workers=2)
    render_room(folder / "room", options, lambda _fraction, _text: None)
    dataset = load_dataset(folder / "room")
    with open_bag(dataset.bag_path) as reader:
        recorded = [
            (connection.topic, time_ns, decode(reader, dataset.bag_path, connection, bytes(raw)))
            for connection, time_ns, raw in messages(reader, dataset.bag_path)
        ]
    truth = read_tum(folder / "room" / "groundtruth.txt")
    return Room(dataset, recorded, np.column_stack((truth.stamps_s, truth.positions_m, truth.quats_xyzw)))


def on(room: Room, topic: str, change: Callable[[int, int, Any], list[tuple[int, Any]]]) -> list[Message]:
    """All messages; ``change`` takes index, receive time and content of one of ``topic``; returns what replaces it."""
    found: list[Message] = []
    index = 0
    for entry in room.messages:
        if entry[0] != topic:
            found.append(entry)
            continue
        found.extend((topic, time_ns, content) for time_ns, content in change(index, entry[1], entry[2]))
        index += 1
    return sorted(found, key=lambda entry: entry[1])


def stamped(message: Any, header_ns: int) -> Any:
    """The message with another header timestamp."""
    stamp = dataclasses.replace(message.header.stamp, sec=header_ns // 10**9, nanosec=header_ns % 10**9)
    return dataclasses.replace(message, header=dataclasses.replace(message.header, stamp=stamp))


def header_ns(message: Any) -> int:
    """The header timestamp."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def with_pixels(message: Any, pixels: Any) -> Any:
    """An image with other pixels, (h, w) uint8."""
    image = np.ascontiguousarray(pixels, dtype=np.uint8)
    height, width = image.shape
    return dataclasses.replace(message, height=height, width=width, step=width, data=image.reshape(-1))


def pixels_of(message: Any) -> Any:
    """The pixels of a grey image, (h, w)."""
    return np.asarray(message.data).reshape(message.height, message.width)


def turned_imu(message: Any, rates: Any, forces: Any) -> Any:
    """An IMU sample with matrices (3, 3) applied to angular rates and specific forces."""
    vectors = {}
    for name, matrix in (("angular_velocity", rates), ("linear_acceleration", forces)):
        old = getattr(message, name)
        x, y, z = np.asarray(matrix) @ (old.x, old.y, old.z)
        vectors[name] = dataclasses.replace(old, x=float(x), y=float(y), z=float(z))
    return dataclasses.replace(message, **vectors)


def with_points(message: Any, change: Callable[[Any], Any]) -> Any:
    """A sweep whose points, a structured array, are what ``change`` makes of them."""
    points = change(np.frombuffer(np.asarray(message.data).tobytes(), dtype=POINT_TYPE).copy())
    data = np.frombuffer(points.tobytes(), dtype=np.uint8)
    return dataclasses.replace(message, width=len(points), row_step=len(data), data=data)


def altered(room: Room, name: str, **changes: Any) -> Dataset:
    """The dataset with other fields of one sensor; ``calibration`` is merged with what is there."""

    def change(sensor: Sensor) -> Sensor:
        calibration = {**sensor.calibration, **changes.get("calibration", {})}
        return dataclasses.replace(sensor, **{**changes, "calibration": calibration})

    sensors = tuple(change(sensor) if sensor.name == name else sensor for sensor in room.dataset.sensors)
    return dataclasses.replace(room.dataset, sensors=sensors)
