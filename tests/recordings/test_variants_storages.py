"""Every step on every storage: the variant of a ROS 2 recording or MCAP file holds what that of the ROS 1 bag holds."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from mcap.reader import SeekingReader as McapReference
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.domain.configuration import VariantStep
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.reader import inspect_bag
from slamhive.recordings.staging import checksum
from slamhive.recordings.variants.steps import STEPS
from slamhive.recordings.writers import storage_of
from tests.recordings.storages import (
    FRAMES,
    SENSORS,
    START_NS,
    STORAGES,
    content_of,
    convert_to,
    dataset_of,
    write_ros1,
)
from tests.recordings.test_variant_steps import EXAMPLES
from tests.recordings.variant_bags import build

pytestmark = pytest.mark.integration

THIRD = VariantStep("rate", ("cam0",), {"every": 3})
HALF = VariantStep("resolution", ("cam0", "depth0"), {"scale": 0.5})
ALWAYS = ("sqlite3", "plain-mcap")
LATER = VariantStep("time_offset", ("imu0",), {"offset_s": 0.5})


@pytest.fixture(scope="module")
def ros1(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("ros1")
    write_ros1(folder / "d.bag")
    return dataset_of(folder, "d.bag")


@pytest.fixture(scope="module")
def sources(ros1: Dataset, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Dataset]:
    root = tmp_path_factory.mktemp("sources")
    return {storage: convert_to(ros1, root / storage, storage) for storage in STORAGES}


@pytest.fixture(params=STORAGES)
def source(request: pytest.FixtureRequest, sources: dict[str, Dataset]) -> Dataset:
    return sources[request.param]


def step_of(kind: str) -> VariantStep:
    """The step with its usual options, on a sensor of this recording that it is made for."""
    example, options = EXAMPLES[kind]
    names = [sensor.name for sensor in SENSORS if sensor.kind is example.kind]
    if kind == "resolution":
        names.append("depth0")
    return VariantStep(kind, tuple(names), cast("dict[str, float]", options))


@pytest.mark.parametrize(("number", "kind"), list(enumerate(sorted(EXAMPLES))))
def test_each_step_makes_of_each_storage_what_it_makes_of_ros1(ros1, sources, tmp_path, number, kind):
    """SQLite and MCAP with every step; folders and compressed forms in turn."""
    assert sorted(EXAMPLES) == STEPS.names()
    step = step_of(kind)
    expected = content_of(build(ros1, tmp_path / "ros1", step).bag_path)
    assert expected != content_of(ros1.bag_path)
    others = sorted(set(STORAGES) - set(ALWAYS))
    for storage in (*ALWAYS, others[number % len(others)]):
        made = build(sources[storage], tmp_path / storage, step)
        assert content_of(made.bag_path) == expected, storage


def test_the_storage_is_kept_and_the_folder_is_a_dataset(source, tmp_path):
    made = build(source, tmp_path / "v", THIRD, HALF, LATER)
    assert load_dataset(tmp_path / "v") == made
    assert made.checksum == checksum(made.bag_path)
    assert made.bag_path.name == source.bag_path.name
    storages = []
    for path in (source.bag_path, made.bag_path):
        with AnyReader([path]) as reader:
            storages.append(storage_of(path, reader))
    assert storages[0] == storages[1]
    assert sorted(path.name for path in (tmp_path / "v").iterdir()) == sorted(
        [made.bag, "dataset.yaml", "groundtruth.txt", "rosbag_play.py"]
    )
    counts = {topic.topic: topic.count for topic in inspect_bag(made.bag_path).topics}
    assert counts["/cam0/image_raw"] == counts["/cam0/camera_info"] == FRAMES // 3
    assert counts["/cam1/image_raw"] == FRAMES


def test_untouched_messages_are_the_same_bytes(source, tmp_path):
    made = build(source, tmp_path / "v", THIRD, HALF)

    def raw(path: Path) -> list[tuple[str, int, bytes]]:
        with AnyReader([path]) as reader:
            wanted = [entry for entry in reader.connections if entry.topic in {"/cam1/image_raw", "/imu0", "/points"}]
            return [(entry.topic, time_ns, data) for entry, time_ns, data in reader.messages(wanted)]

    assert raw(made.bag_path) == raw(source.bag_path)


def test_equal_steps_make_equal_bytes(source, tmp_path):
    one, two = (build(source, tmp_path / name, THIRD, HALF, LATER) for name in ("one", "two"))
    assert one.checksum == two.checksum


def test_definitions_and_quality_of_service_are_kept(source, tmp_path):
    made = build(source, tmp_path / "v", THIRD)

    def described(path: Path) -> list[tuple[object, ...]]:
        with AnyReader([path]) as reader:
            return [(entry.topic, entry.msgtype, entry.msgdef, entry.digest, entry.ext) for entry in reader.connections]

    assert described(made.bag_path) == described(source.bag_path)


def test_a_recording_without_definitions_is_treated_and_its_unknown_types_are_copied(tmp_path):
    """As ROS 2 Humble writes them to SQLite."""
    store = vendor_types()
    humble = write_humble(tmp_path / "d", store)
    sensors = tuple(sensor for sensor in SENSORS if sensor.name == "imu0")
    source = Dataset("d", tmp_path, "d", 1.0, sensors, None, checksum(humble))
    made = build(source, tmp_path / "v", VariantStep("imu_bias", ("imu0",), {"gyroscope": 0.5}))
    with AnyReader([made.bag_path], default_typestore=store) as reader:
        found = {entry.topic: (raw, entry.msgtype) for entry, _, raw in reader.messages()}
        imu: Any = reader.deserialize(found["/imu0"][0], found["/imu0"][1])
    assert np.linalg.norm([imu.angular_velocity.x, imu.angular_velocity.y, imu.angular_velocity.z]) == pytest.approx(
        0.5
    )
    assert found["/odd"] == (bytes(odd_message(store)), "vendor_msgs/msg/Odd")


def vendor_types():
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("std_msgs/Header header\nuint8 tag", "vendor_msgs/msg/Odd"))
    return store


def odd_message(store):
    stamp = store.types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="f")
    return store.serialize_cdr(store.types["vendor_msgs/msg/Odd"](header=header, tag=7), "vendor_msgs/msg/Odd")


def write_humble(path: Path, store, seconds: int = 1000) -> Path:
    """A recording in SQLite without type definitions."""
    make = store.types
    zero = make["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    header = make["std_msgs/msg/Header"](
        stamp=make["builtin_interfaces/msg/Time"](sec=seconds, nanosec=7), frame_id="imu0"
    )
    imu = make["sensor_msgs/msg/Imu"](
        header=header,
        orientation=make["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=zero,
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=zero,
        linear_acceleration_covariance=np.zeros(9),
    )
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        known = writer.add_connection("/imu0", "sensor_msgs/msg/Imu", typestore=store)
        odd = writer.add_connection("/odd", "vendor_msgs/msg/Odd", typestore=store)
        writer.write(known, START_NS, store.serialize_cdr(imu, "sensor_msgs/msg/Imu"))
        writer.write(odd, START_NS + 1, odd_message(store))
    with sqlite3.connect(path / "d.db3") as database:
        database.execute("DELETE FROM message_definitions")
        database.execute("UPDATE topics SET type_description_hash = ''")
    metadata = (path / "metadata.yaml").read_text()
    lines = [line for line in metadata.splitlines() if "type_description_hash" not in line]
    (path / "metadata.yaml").write_text("\n".join(lines) + "\n")
    return path


def test_damaged_bytes_never_escape_as_anything_else(source, tmp_path):
    rng = np.random.default_rng(0)
    for number in range(6):
        folder = tmp_path / f"s{number}"
        shutil.copytree(source.folder, folder)
        recording = folder / source.bag
        files = [recording] if recording.is_file() else sorted(recording.iterdir())
        victim = max(files, key=lambda path: path.stat().st_size)
        broken = bytearray(victim.read_bytes())
        for position in rng.integers(8, len(broken), 20):
            broken[position] = int(rng.integers(0, 256))
        victim.write_bytes(broken[: len(broken) // 2] if number == 0 else broken)
        with suppress(InvalidInput):
            build(dataset_of(folder, source.bag), tmp_path / f"v{number}", THIRD, HALF)


def test_a_full_disk_leaves_no_file_beside_the_recording(sources, tmp_path, monkeypatch):
    monkeypatch.setattr(Writer, "write", full)
    for storage in ("mcap", "plain-mcap", "sqlite3"):
        with pytest.raises(OSError, match="full"):
            build(sources[storage], tmp_path / storage, THIRD)
        left = [path for path in (tmp_path / storage).iterdir() if path.name.endswith(".partial")]
        assert not left


def full(*_arguments):
    raise sqlite3.OperationalError("database or disk is full")


def test_a_timestamp_out_of_range_is_refused(tmp_path):
    humble = write_humble(tmp_path / "d", vendor_types(), seconds=2**31 - 2)
    sensors = tuple(sensor for sensor in SENSORS if sensor.name == "imu0")
    source = Dataset("d", tmp_path, "d", 1.0, sensors, None, checksum(humble))
    with pytest.raises(InvalidInput, match="this recording knows times from 0 s to 2147483648 s"):
        build(source, tmp_path / "v", VariantStep("time_offset", ("imu0",), {"offset_s": 5.0}))


@pytest.mark.shared_data
def test_a_recording_that_ros2_made_is_thinned_and_the_rest_is_copied(tmp_path):
    recorded = project_root().parent / "shared" / "data" / "evo_trajectories" / "nav2_turtlebot.mcap"
    if not recorded.is_file():
        pytest.skip(f"{recorded} is not here (shared/data)")
    shutil.copyfile(recorded, tmp_path / "d.mcap")
    sensors = (Sensor("odometry", SensorKind.IMU, "/odom", 20.0),)
    source = Dataset("d", tmp_path, "d.mcap", 97.0, sensors, None, checksum(recorded))
    made = build(source, tmp_path / "v", VariantStep("rate", ("odometry",), {"every": 2}))
    before, after = raw_of(recorded), raw_of(made.bag_path)
    assert after["/odom"] == before["/odom"][::2]
    assert after == {**before, "/odom": after["/odom"]}
    assert len(before["/tf"]) == 5422


def raw_of(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    found: dict[str, list[tuple[int, bytes]]] = {}
    with AnyReader([path]) as reader:
        for entry, time_ns, data in reader.messages():
            found.setdefault(entry.topic, []).append((time_ns, data))
    return found


@pytest.mark.parametrize("compression", list(CompressionType))
def test_files_of_the_reference_implementation_of_mcap_are_treated(sources, tmp_path, compression):
    """Without compression, with LZ4 and with Zstandard; LZ4 becomes Zstandard."""
    source = tmp_path / "s"
    source.mkdir()
    write_with_reference(sources["plain-mcap"].bag_path, source / "d.mcap", compression)
    made = build(dataset_of(source, "d.mcap"), tmp_path / "v", THIRD, HALF)
    expected = build(sources["plain-mcap"], tmp_path / "expected", THIRD, HALF)
    assert content_of(made.bag_path) == content_of(expected.bag_path)
    with made.bag_path.open("rb") as stream:
        summary = McapReference(stream).get_summary()
    assert summary is not None
    assert {chunk.compression for chunk in summary.chunk_indexes} == {
        "" if compression is CompressionType.NONE else "zstd"
    }


def write_with_reference(recorded: Path, path: Path, compression: CompressionType) -> None:
    with AnyReader([recorded]) as reader, path.open("wb") as stream:
        writer = McapWriter(stream, compression=compression)
        writer.start(profile="ros2")
        channels = {
            entry.id: writer.register_channel(
                entry.topic, "cdr", writer.register_schema(entry.msgtype, "ros2msg", entry.msgdef.data.encode())
            )
            for entry in reader.connections
        }
        for entry, time_ns, data in reader.messages():
            writer.add_message(channels[entry.id], time_ns, data, time_ns)
        writer.finish()
