"""TUM-VI, Newer College, Hilti 2022 and Livox: recordings with the names, topics and files of these datasets.

The recordings are written with rosbags. The datasets themselves are too large for tests.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from slamhive.base.errors import InvalidInput
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import IDENTITY4, Sensor, SensorKind
from slamhive.recordings.importers.registry import detect_format, plan_import
from slamhive.recordings.importers.rosbag_benchmarks import read_registered_poses
from slamhive.recordings.importing import ImportOptions, RewrittenRecording, perform
from slamhive.recordings.reader import decode, messages, open_bag
from slamhive.recordings.writers import BagWriter
from slamhive.runtime.messages import to_points
from slamhive.trajectory.layout import read_tum
from tests.recordings.test_import_ros import FRAMES, silent, write_with_truth

pytestmark = pytest.mark.quick

START_NS, PERIOD_NS, SWEEPS, POINTS = 10**12, 100_000_000, 4, 5
LIVOX = """
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
livox_ros_driver2/CustomPoint[] points
================================================================================
MSG: livox_ros_driver2/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""


def livox_store(store: Stores) -> Any:
    made = get_typestore(store)
    made.register(get_types_from_msg(LIVOX, "livox_ros_driver2/msg/CustomMsg"))
    return made


def custom_message(store: Any, number: int, *, seq: bool) -> Any:
    stamp_ns = START_NS + number * PERIOD_NS
    kind = store.types["livox_ros_driver2/msg/CustomPoint"]
    points = [
        kind(offset_time=1000 * index, x=1.0 + index, y=2.0, z=float(number), reflectivity=9, tag=3, line=index % 4)
        for index in range(POINTS)
    ]
    stamp = store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    head = store.types["std_msgs/msg/Header"](**({"seq": 0} if seq else {}), stamp=stamp, frame_id="livox_frame")
    return store.types["livox_ros_driver2/msg/CustomMsg"](
        header=head, timebase=stamp_ns, point_num=POINTS, lidar_id=1, rsvd=np.zeros(3, np.uint8), points=points
    )


def write_livox(folder: Path, version: int) -> Path:
    kind = "livox_ros_driver2/msg/CustomMsg"
    if version == 1:
        store = livox_store(Stores.ROS1_NOETIC)
        path = folder / "livox.bag"
        with Ros1Writer(path) as writer:
            connection = writer.add_connection("/livox/lidar", kind, typestore=store)
            for number in range(SWEEPS):
                raw = store.serialize_ros1(custom_message(store, number, seq=True), kind)
                writer.write(connection, START_NS + number * PERIOD_NS, raw)
        return path
    store = livox_store(Stores.ROS2_HUMBLE)
    path = folder / "livox"
    with Ros2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer2:
        connection = writer2.add_connection("/livox/lidar", kind, typestore=store)
        for number in range(SWEEPS):
            raw = store.serialize_cdr(custom_message(store, number, seq=False), kind)
            writer2.write(connection, START_NS + number * PERIOD_NS, raw)
    return path


@pytest.mark.parametrize("version", [1, 2])
def test_livox_messages_become_point_clouds(tmp_path, version):
    plan = plan_import(write_livox(tmp_path, version), ImportOptions())[1]
    assert isinstance(plan.recording, RewrittenRecording)
    dataset = perform(plan, tmp_path / "made", silent)
    lidar = dataset.sensor("lidar0")
    assert lidar.rate_hz == pytest.approx(10)
    assert (lidar.calibration["point_time_field"], lidar.calibration["point_time_unit"]) == ("offset_time", "ns")
    with open_bag(dataset.bag_path) as reader:
        clouds = [decode(reader, dataset.bag_path, *entry[::2]) for entry in messages(reader, dataset.bag_path)]
    assert len(clouds) == SWEEPS
    cloud = to_points(clouds[3])
    assert cloud.points_m.tolist() == [[1.0 + index, 2.0, 3.0] for index in range(POINTS)]
    assert cloud.fields["offset_time"].tolist() == [1000 * index for index in range(POINTS)]
    assert cloud.fields["line"].tolist() == [0, 1, 2, 3, 0]


FIELDS: dict[str, tuple[list[Any], tuple[str, ...]]] = {
    "velodyne": ([("time", "<f4", 0.01), ("ring", "<u2", 1)], ("time", "s", "timestamp", "start")),
    "ouster": ([("t", "<u4", 10_000_000), ("ring", "u1", 1)], ("t", "ns", "timestamp", "start")),
    "hesai": ([("timestamp", "<f8", None), ("ring", "<u2", 1)], ("timestamp", "s", "absolute", "start")),
    "velodyne at the end": ([("time", "<f4", -0.01), ("ring", "<u2", 1)], ("time", "s", "timestamp", "end")),
}


@pytest.mark.parametrize("maker", list(FIELDS))
def test_the_time_of_a_point_is_found_in_the_fields(tmp_path, maker):
    fields, expected = FIELDS[maker]
    source = tmp_path / "lidar.bag"
    write_lidar(source, fields)
    found = plan_import(source, ImportOptions())[1].sensors[0].calibration
    keys = ("point_time_field", "point_time_unit", "point_time_reference", "stamp")
    assert tuple(found[key] for key in keys) == expected
    assert (found["ring_field"], found["beams"]) == ("ring", 10)


def write_lidar(path: Path, fields: list[Any], first_ns: int = START_NS) -> None:
    """Sweeps of ten points; each more field counts by its step from 0, from the timestamp where there is no step."""
    sensor = Sensor("lidar0", SensorKind.LIDAR, "/os1_cloud_node/points", 10.0)
    layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *((name, kind) for name, kind, _ in fields)])
    with BagWriter(path) as writer:
        for number in range(SWEEPS):
            stamp_ns = first_ns + number * PERIOD_NS
            points = np.zeros(10, layout)
            points["x"] = 5.0
            for name, _, step in fields:
                points[name] = stamp_ns / 1e9 + 0.01 * np.arange(10) if step is None else step * np.arange(10)
            writer.points(sensor, stamp_ns, stamp_ns, points)


def convert(source: Path, folder: Path, **options: Any) -> Dataset:
    return perform(plan_import(source, ImportOptions(**options))[1], folder, silent)


def test_tum_vi_takes_the_motion_capture_of_its_bag(tmp_path):
    source = tmp_path / "dataset-room1_512_16.bag"
    write_with_truth(source, "geometry_msgs/msg/TransformStamped", "/vrpn_client/raw_transform", placed=False)
    assert detect_format(source) == "tum-vi"
    assert any(
        "ground truth is taken as poses of the IMU" in note for note in plan_import(source, ImportOptions())[1].notes
    )
    dataset = convert(source, tmp_path / "made")
    assert dataset.title == "TUM-VI, room1_512_16"
    assert dataset.attributes == ("real", "indoor", "handheld")
    assert dataset.groundtruth is not None
    assert dataset.groundtruth.source == "topic /vrpn_client/raw_transform"
    assert dataset.sensor("imu0").T_body_sensor == IDENTITY4
    assert read_tum(dataset.folder / "groundtruth.txt").positions_m[-1] == pytest.approx([0.1 * (FRAMES - 1), 0, 0])


def test_the_parts_of_newer_college_become_one_bag(tmp_path):
    source = tmp_path / "01_short_experiment"
    source.mkdir()
    velodyne = FIELDS["ouster"][0]
    for part in range(3):
        write_lidar(source / f"rooster_{part}.bag", velodyne, START_NS + part * SWEEPS * PERIOD_NS)
    rows = [f"{1000 + i // 10}, {(i % 10) * 100_000_000}, {i}, 0, 0, 0, 0, 0, 1" for i in range(12)]
    (source / "registered_poses.csv").write_text("#sec, nsec, x, y, z, qx, qy, qz, qw\n" + "\n".join(rows))
    assert detect_format(source) == "newer-college"
    dataset = convert(source, tmp_path / "made")
    with open_bag(dataset.bag_path) as reader:
        received = [entry[1] for entry in messages(reader, dataset.bag_path)]
    assert received == [START_NS + number * PERIOD_NS for number in range(3 * SWEEPS)]
    truth = read_tum(dataset.folder / "groundtruth.txt")
    assert truth.stamps_s[-1] == pytest.approx(1001.1)
    # The body is the LiDAR, the only sensor, and the ground truth has the poses of the frame base.
    assert truth.positions_m[-1] == pytest.approx([11 - 0.084, -0.025, 0.050])


def test_newer_college_names_a_bad_line(tmp_path):
    write_lidar(tmp_path / "a.bag", FIELDS["ouster"][0])
    (tmp_path / "registered_poses.csv").write_text("1000, 0, 0, 0, 0, 0, 0, 0, 1\n1000, 0, 0, 0, 0, 0, 0, 0, 1\n")
    with pytest.raises(InvalidInput, match=r"registered_poses.csv, line 2: timestamp 1000.000000000 occurs twice"):
        plan_import(tmp_path, ImportOptions())


@pytest.mark.parametrize("row", ["1000.5 1 2 3 0 0 0 1", "1000, 500000000, 1, 2, 3, 0, 0, 0, 1"])
@pytest.mark.parametrize("indent", ["", "  ", "\t"])
def test_poses_of_newer_college_may_be_indented(tmp_path, row, indent):
    path = tmp_path / "registered_poses.csv"
    path.write_text(f"{indent}# poses\n{indent}{row}\n")
    found = read_registered_poses(path)
    assert (found.times_s.tolist(), found.positions_m.tolist()) == ([1000.5], [[1, 2, 3]])


def test_hilti_takes_the_files_beside_its_bag(tmp_path):
    source = tmp_path / "exp01_construction_ground_level.bag"
    write_lidar(source, FIELDS["hesai"][0])
    truth = tmp_path / f"{source.stem}_imu.txt"
    truth.write_text("".join(f"{1000 + i / 10} {i} 0 0 0 0 0 1\n" for i in range(SWEEPS)))
    assert detect_format(source) == "hilti-2022"
    dataset = convert(source, tmp_path / "made")
    assert dataset.groundtruth is not None
    assert dataset.groundtruth.source == f"file {truth.name}"
    assert dataset.title == "Hilti 2022, exp01_construction_ground_level"
