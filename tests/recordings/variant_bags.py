"""Small ROS 1 bags for tests of variants, and reading them back."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore

from slamhive.domain.configuration import VariantStep
from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.variants.build import build_variant

STORE = get_typestore(Stores.ROS1_NOETIC)
IMAGE, INFO, IMU = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu"
COMPRESSED, TEXT = "sensor_msgs/msg/CompressedImage", "std_msgs/msg/String"
SIZE = (64, 48)
START_NS, PERIOD_NS = 10**12, 50_000_000
FRAMES = 12


@dataclass(frozen=True)
class Recorded:
    """One message of a bag."""

    topic: str
    type: str
    time_ns: int
    raw: bytes

    @property
    def message(self) -> Any:
        return STORE.deserialize_ros1(self.raw, self.type)


def camera(name: str = "cam0", **calibration: Any) -> Sensor:
    known: dict[str, Any] = {
        "width": SIZE[0],
        "height": SIZE[1],
        "fx": 50.0,
        "fy": 51.0,
        "cx": 31.25,
        "cy": 22.5,
        "encoding": "mono8",
    }
    return Sensor(name, SensorKind.CAMERA, f"/{name}/image_raw", 20.0, calibration={**known, **calibration})


def message(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def header(stamp_ns: int, frame: str = "camera") -> Any:
    stamp = message("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return message("std_msgs/msg/Header", seq=7, stamp=stamp, frame_id=frame)


def image(pixels: Any, stamp_ns: int, encoding: str = "mono8", frame: str = "camera") -> Any:
    pixels = np.ascontiguousarray(pixels)
    return message(
        IMAGE,
        header=header(stamp_ns, frame),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=pixels.reshape(-1).view(np.uint8),
    )


def info(sensor: Sensor, stamp_ns: int, **fields: Any) -> Any:
    c: Any = sensor.calibration
    region = message("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    known = {
        "height": c["height"],
        "width": c["width"],
        "distortion_model": "plumb_bob",
        "D": np.array([0.1, -0.2, 0.001, 0.002, 0.0]),
        "K": np.array([c["fx"], 0, c["cx"], 0, c["fy"], c["cy"], 0, 0, 1.0]),
        "R": np.array([0.0, -1, 0, 1, 0, 0, 0, 0, 1]),
        "P": np.array([c["fx"], 0, c["cx"], -5.5, 0, c["fy"], c["cy"], 0, 0, 0, 1.0, 0]),
        "binning_x": 0,
        "binning_y": 0,
        "roi": region,
    }
    return message(INFO, header=header(stamp_ns), **{**known, **fields})


def text(words: str) -> Any:
    return message(TEXT, data=words)


def pixels_of(number: int) -> Any:
    return np.random.default_rng(number).integers(0, 255, SIZE[::-1], dtype=np.uint8)


def write_bag(
    path: Path, entries: list[tuple[str, int, Any]], compression: str | None = None, chunk: int = 9000
) -> None:
    """Write messages (topic, receive time, message) in the order given, in chunks of about ``chunk`` bytes."""
    writer = Writer(path)
    writer.chunk_threshold = chunk
    if compression is not None:
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    connections: dict[str, Any] = {}
    with writer:
        for topic, time_ns, content in entries:
            kind = content.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], time_ns, STORE.serialize_ros1(content, kind))


def read_bag(path: Path) -> list[Recorded]:
    """All messages in order of time."""
    with Reader(path) as reader:
        return [Recorded(entry.topic, entry.msgtype, time_ns, raw) for entry, time_ns, raw in reader.messages()]


def on_topic(path: Path, topic: str) -> list[Recorded]:
    return [entry for entry in read_bag(path) if entry.topic == topic]


def stereo(frames: int = FRAMES) -> list[tuple[str, int, Any]]:
    """Two cameras with their CameraInfo, and words that no step knows."""
    entries: list[tuple[str, int, Any]] = []
    for frame in range(frames):
        stamp_ns = START_NS + frame * PERIOD_NS
        for number, name in enumerate(("cam0", "cam1")):
            entries.append((f"/{name}/camera_info", stamp_ns, info(camera(name), stamp_ns)))
            entries.append((f"/{name}/image_raw", stamp_ns, image(pixels_of(2 * frame + number), stamp_ns)))
        entries.append(("/words", stamp_ns + 1000, text(f"frame {frame}")))
    return entries


def dataset(folder: Path, sensors: tuple[Sensor, ...] | None = None) -> Dataset:
    """The dataset whose recording is ``folder/d.bag``."""
    (folder / "groundtruth.txt").write_text("1000 0 0 0 0 0 0 1\n")
    digest = hashlib.sha256((folder / "d.bag").read_bytes()).hexdigest()
    sensors = sensors or (camera("cam0"), camera("cam1"))
    truth = GroundTruth("groundtruth.txt", gravity_aligned=True)
    return Dataset("d", folder, "d.bag", 0.55, sensors, truth, f"sha256:{digest}")


def build(source: Dataset, target: Path, *steps: VariantStep) -> Dataset:
    target.mkdir()
    return build_variant(source, steps, target, lambda _fraction, _text: None)
