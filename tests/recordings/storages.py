"""One small recording of all kinds of sensors, in every storage that recordings come in."""

from __future__ import annotations

import shutil
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.convert.converter import convert
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.staging import checksum
from slamhive.recordings.writers import BagWriter
from tests.recordings.variant_bags import camera, pixels_of

START_NS, PERIOD_NS, FRAMES = 10**12 + 7, 50_000_000, 12
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4"), ("ring", "<u2")])
SENSORS = (
    camera("cam0"),
    camera("cam1"),
    Sensor(
        "depth0",
        SensorKind.DEPTH,
        "/depth0/image_raw",
        20.0,
        calibration={**camera().calibration, "encoding": "16UC1", "units_per_m": 1000, "registered_to": "cam0"},
    ),
    Sensor("imu0", SensorKind.IMU, "/imu0", 100.0),
    Sensor(
        "lidar0",
        SensorKind.LIDAR,
        "/points",
        20.0,
        calibration={"beams": 4, "minimum_range_m": 0.3, "maximum_range_m": 80.0},
    ),
)
ROS1 = "ros1"
STORAGES: dict[str, tuple[str, dict[str, str]]] = {
    "sqlite3": ("d", {}),
    "sqlite3-file-zstd": ("d", {"compress": "zstd", "compress_mode": "file"}),
    "sqlite3-message-zstd": ("d", {"compress": "zstd", "compress_mode": "message"}),
    "mcap": ("d", {"dst_storage": "mcap"}),
    "mcap-message-zstd": ("d", {"dst_storage": "mcap", "compress": "zstd", "compress_mode": "message"}),
    "mcap-chunk-zstd": ("d", {"dst_storage": "mcap", "compress": "zstd", "compress_mode": "storage"}),
    "plain-mcap": ("d.mcap", {"dst_storage": "mcap"}),
    "plain-mcap-zstd": ("d.mcap", {"dst_storage": "mcap", "compress": "zstd", "compress_mode": "storage"}),
    "plain-db3": ("d.db3", {}),
}
"""The name of the recording of each storage, and how the converter of rosbags is asked for it."""


def write_ros1(path: Path) -> None:
    """Two cameras, depth, IMU at five times their rate, and LiDAR."""
    cam0, cam1, depth, imu, lidar = SENSORS
    random = np.random.default_rng(1)
    with BagWriter(path) as bag:
        for frame in range(FRAMES):
            stamp_ns = START_NS + frame * PERIOD_NS
            for number, sensor in enumerate((cam0, cam1)):
                bag.camera_info(sensor, f"/{sensor.name}/camera_info", stamp_ns, 0.1 * number)
                bag.image(sensor, stamp_ns, pixels_of(2 * frame + number), "mono8")
            bag.camera_info(depth, "/depth0/camera_info", stamp_ns)
            bag.image(depth, stamp_ns, random.integers(0, 8000, (48, 64), dtype=np.uint16), "16UC1")
            points = np.zeros(40, POINT)
            for axis in ("x", "y", "z"):
                points[axis] = random.uniform(-30, 30, len(points))
            points["t"] = np.arange(len(points)) * (PERIOD_NS // len(points))
            points["ring"] = np.arange(len(points)) % 4
            bag.points(lidar, stamp_ns, stamp_ns + 1000, points)
            for part in range(5):
                sample_ns = stamp_ns + 2000 + part * PERIOD_NS // 5
                bag.imu(imu, sample_ns, random.standard_normal(3), random.standard_normal(3) * 10)


def dataset_of(folder: Path, bag: str) -> Dataset:
    """The dataset whose recording is ``folder/bag``."""
    (folder / "groundtruth.txt").write_text("1000 0 0 0 0 0 0 1\n")
    truth = GroundTruth("groundtruth.txt", gravity_aligned=True)
    return Dataset("d", folder, bag, 0.55, SENSORS, truth, checksum(folder / bag))


def convert_to(source: Dataset, folder: Path, storage: str) -> Dataset:
    """The recording of ``source``, a ROS 1 bag, in another storage, converted by rosbags."""
    bag, options = STORAGES[storage]
    folder.mkdir()
    made = folder / Path(bag).stem
    settings: dict[str, Any] = {
        "dst_storage": "sqlite3",
        "dst_version": 8,
        "compress": None,
        "compress_mode": "file",
        "default_typestore": None,
        "typestore": get_typestore(Stores.ROS2_HUMBLE),
        "exclude_topics": [],
        "include_topics": [],
        "exclude_msgtypes": [],
        "include_msgtypes": [],
    }
    convert([source.bag_path], made, **{**settings, **options})
    if Path(bag).suffix:
        (made / bag).rename(folder / "moved")
        shutil.rmtree(made)
        (folder / "moved").rename(folder / bag)
    return replace(dataset_of(folder, bag), groundtruth=source.groundtruth)


def content_of(path: Path) -> dict[str, list[tuple[int, str]]]:
    """By topic: when each message was received, and all it contains but the sequence number of ROS 1."""
    found: dict[str, list[tuple[int, str]]] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, received_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((received_ns, _text(message)))
    return found


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return blake2b(value.tobytes()).hexdigest()
    if isinstance(value, list):
        return str([_text(entry) for entry in value])
    if hasattr(value, "__dataclass_fields__"):
        names = [name for name in value.__dataclass_fields__ if name not in {"seq", "__msgtype__"}]
        return str([f"{name.lower()}={_text(getattr(value, name))}" for name in names])
    return repr(value)
