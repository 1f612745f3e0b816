"""What is exported is all there: by the readers of each format, pixel for pixel and nanosecond for nanosecond."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from evo.tools import file_interface
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML

from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.base.files import size_bytes
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import SensorKind
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.exporters import EXPORTERS, export_dataset, plan_export
from slamhive.recordings.room import RoomOptions, render_room
from slamhive.recordings.staging import checksum
from slamhive.recordings.writers import BagWriter
from slamhive.trajectory.layout import read_tum
from tests.recordings.storages import content_of, convert_to

pytestmark = pytest.mark.integration

START_NS = 1_000_000_000_000
"""When the room starts."""
SIDE_FILES = ["groundtruth.txt", "reference_map.pcd"]


def silent(_fraction: float, _text: str) -> None:
    pass


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("datasets") / "room"
    return render_room(folder, RoomOptions(duration_s=0.5, width=64, height=48, workers=1), silent)


def export(dataset: Dataset, name: str, folder: Path, *, partial: bool = True) -> Path:
    export_dataset(plan_export(dataset, name, partial=partial), folder, silent)
    return folder


def images_of(dataset: Dataset, sensor: str) -> list[tuple[int, Any]]:
    """Header timestamps (ns) and pixels."""
    found = []
    with AnyReader([dataset.bag_path]) as reader:
        wanted = [entry for entry in reader.connections if entry.topic == dataset.sensor(sensor).topic]
        for connection, _, raw in reader.messages(wanted):
            message: Any = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp
            dtype = np.uint16 if message.encoding == "16UC1" else np.uint8
            pixels = message.data.view(dtype).reshape(message.height, message.width)
            found.append((stamp.sec * 10**9 + stamp.nanosec, pixels))
    assert found
    return found


def check_images(entries: list[tuple[int, Path]], expected: list[tuple[int, Any]]) -> None:
    assert [stamp_ns for stamp_ns, _ in entries] == [stamp_ns for stamp_ns, _ in expected]
    for (_, path), (_, pixels) in zip(entries, expected, strict=True):
        np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), pixels)


def rows_of(path: Path) -> list[list[str]]:
    with path.open(newline="") as stream:
        return list(csv.reader(stream))


@pytest.mark.parametrize("name", ["ros1", "ros2", "mcap"])
def test_recordings_of_ros_hold_everything(room, tmp_path, name):
    folder = export(room, name, tmp_path / "out", partial=False)
    made = load_dataset(folder)
    assert made == replace(room, folder=folder, bag=made.bag, checksum=made.checksum)
    assert made.checksum == checksum(made.bag_path)
    assert content_of(made.bag_path) == content_of(room.bag_path)
    for file in SIDE_FILES:
        assert (folder / file).read_bytes() == (room.folder / file).read_bytes()
    assert sorted(path.name for path in folder.iterdir()) == sorted(["dataset.yaml", made.bag, *SIDE_FILES])


@pytest.mark.parametrize("first", ["ros1", "ros2", "mcap"])
@pytest.mark.parametrize("second", ["ros1", "ros2", "mcap"])
def test_each_recording_of_ros_becomes_each_other(room, tmp_path, first, second):
    between = load_dataset(export(room, first, tmp_path / "first", partial=False))
    made = load_dataset(export(between, second, tmp_path / "second", partial=False))
    assert content_of(made.bag_path) == content_of(room.bag_path)
    if first == second:
        assert made.checksum == between.checksum


def test_messages_of_ros2_have_the_definitions_of_ros2(room, tmp_path):
    """ROS 2 refuses types whose hash differs from that of its own."""
    made = load_dataset(export(room, "ros2", tmp_path / "out"))
    with AnyReader([made.bag_path]) as reader:
        info: Any = next(
            reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages()
            if connection.topic == "/cam0/camera_info"
        )
    assert info.k[0] == room.sensor("cam0").calibration["fx"]


@pytest.mark.parametrize("storage", ["sqlite3-file-zstd", "mcap-chunk-zstd"])
def test_compressed_recordings_are_exported(room, tmp_path, storage):
    source = replace(convert_to(room, tmp_path / storage, storage), sensors=room.sensors)
    assert plan_export(source, "ros1", partial=False).needed_bytes > size_bytes(room.bag_path)
    folder = export(source, "ros1", tmp_path / "out")
    assert content_of(folder / "d.bag") == content_of(room.bag_path)


def test_euroc(room, tmp_path):
    mav = export(room, "euroc", tmp_path / "out") / "mav0"
    for name in ("cam0", "cam1"):
        head, *rows = rows_of(mav / name / "data.csv")
        assert head == ["#timestamp [ns]", "filename"]
        check_images([(int(row[0]), mav / name / "data" / row[1]) for row in rows], images_of(room, name))
        described = YAML(typ="safe").load((mav / name / "sensor.yaml").read_text().partition("\n")[2])
        calibration: Any = room.sensor(name).calibration
        assert described["T_BS"]["data"] == list(room.sensor(name).T_body_sensor)
        assert described["intrinsics"] == [calibration[key] for key in ("fx", "fy", "cx", "cy")]
        assert described["resolution"] == [64, 48]
    samples = rows_of(mav / "imu0" / "data.csv")
    assert len(samples) == 102
    assert len(samples[1]) == 7
    truth = file_interface.read_euroc_csv_trajectory(mav / "state_groundtruth_estimate0" / "data.csv")
    expected = read_tum(room.folder / "groundtruth.txt")
    np.testing.assert_array_equal(truth.positions_xyz, expected.positions_m)
    np.testing.assert_allclose(truth.timestamps, expected.stamps_s, atol=1e-9)
    np.testing.assert_array_equal(truth.orientations_quat_wxyz[:, [1, 2, 3, 0]], expected.quats_xyzw)


def test_tum_rgbd(room, tmp_path):
    folder = export(room, "tum-rgbd", tmp_path / "out")
    for name, sensor in (("rgb", "cam0"), ("depth", "depth0")):
        lines = [line.split() for line in (folder / f"{name}.txt").read_text().splitlines() if line[0] != "#"]
        entries = [(round(float(seconds) * 1e9), folder / file) for seconds, file in lines]
        check_images(entries, images_of(room, sensor))
    truth = file_interface.read_tum_trajectory_file(folder / "groundtruth.txt")
    body = file_interface.read_tum_trajectory_file(room.folder / "groundtruth.txt")
    T = np.array(room.sensor("cam0").T_body_sensor).reshape(4, 4)
    for pose, expected in zip(truth.poses_se3[::20], body.poses_se3[::20], strict=True):
        np.testing.assert_allclose(pose, expected @ T, atol=1e-8)
    described = load_dataset(folder)
    assert [sensor.name for sensor in described.sensors] == ["cam0", "depth0"]
    assert described.sensor("cam0").calibration == room.sensor("cam0").calibration


def test_vslam_lab(room, tmp_path):
    folder = export(room, "vslam-lab", tmp_path / "out")
    head, *rows = rows_of(folder / "rgb.csv")
    for place, (name, sensor) in enumerate((("rgb_0", "cam0"), ("rgb_1", "cam1"), ("depth_0", "depth0"))):
        assert head[2 * place : 2 * place + 2] == [f"ts_{name} (ns)", f"path_{name}"]
        check_images([(int(row[2 * place]), folder / row[2 * place + 1]) for row in rows], images_of(room, sensor))
    calibration = YAML(typ="safe").load((folder / "calibration.yaml").read_text())
    left, right = calibration["cameras"]
    assert left["depth_factor"] == 1000
    assert left["focal_length"] == [room.sensor("cam0").calibration["fx"], room.sensor("cam0").calibration["fy"]]
    assert right["T_BS"] == list(room.sensor("cam1").T_body_sensor)
    (imu,) = calibration["imus"]
    assert imu["sigma_g_c"] == room.sensor("imu0").calibration["gyroscope_noise_density"]
    assert len(rows_of(folder / "imu_0.csv")) == 102
    head, *poses = rows_of(folder / "groundtruth.csv")
    expected = read_tum(room.folder / "groundtruth.txt")
    values = np.array([[float(value) for value in row[1:]] for row in poses])
    np.testing.assert_array_equal(values[:, :3], expected.positions_m)
    np.testing.assert_array_equal(values[:, 3:], expected.quats_xyzw)


def test_kitti(room, tmp_path):
    folder = export(room, "kitti", tmp_path / "out")
    times_s = np.loadtxt(folder / "times.txt")
    for number in (0, 1):
        files = sorted((folder / f"image_{number}").iterdir())
        entries = [(START_NS + round(time_s * 1e9), file) for time_s, file in zip(times_s, files, strict=True)]
        check_images(entries, images_of(room, f"cam{number}"))
    poses = file_interface.read_kitti_poses_file(folder / "poses.txt").poses_se3
    body = file_interface.read_tum_trajectory_file(room.folder / "groundtruth.txt")
    T = np.array(room.sensor("cam0").T_body_sensor).reshape(4, 4)
    assert len(poses) == len(times_s)
    for pose, expected in zip(poses, body.poses_se3[::10], strict=True):
        np.testing.assert_allclose(pose, expected @ T, atol=1e-8)
    projections = {line.split(":")[0]: line for line in (folder / "calib.txt").read_text().splitlines()}
    P1 = np.array([float(word) for word in projections["P1"].split()[1:]]).reshape(3, 4)
    assert -P1[0, 3] / P1[0, 0] == pytest.approx(0.12)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("euroc", "euroc cannot hold all of dataset room: depth0 (depth), lidar0 (lidar), the reference map"),
        ("tum-rgbd", "cam1 (camera), imu0 (imu), lidar0 (lidar), the reference map"),
        ("kitti", "depth0 (depth), imu0 (imu), lidar0 (lidar), the reference map"),
        ("vslam-lab", "lidar0 (lidar), the reference map"),
    ],
)
def test_what_a_format_cannot_hold_must_be_left_out_by_request(room, name, words):
    with pytest.raises(InvalidInput) as caught:
        plan_export(room, name, partial=False)
    assert words in str(caught.value)
    assert "--partial" in str(caught.value)


def without(dataset: Dataset, *kinds: SensorKind) -> Dataset:
    return replace(dataset, sensors=tuple(sensor for sensor in dataset.sensors if sensor.kind not in kinds))


def calibrated(dataset: Dataset, name: str, **changes: Any) -> Dataset:
    sensors = tuple(
        replace(sensor, calibration={**sensor.calibration, **changes}) if sensor.name == name else sensor
        for sensor in dataset.sensors
    )
    return replace(dataset, sensors=sensors)


def test_content_that_a_format_is_not_for_is_refused(room):
    refusals = [
        ("tum-rgbd", without(room, SensorKind.DEPTH), "has no depth"),
        ("tum-rgbd", without(room, SensorKind.CAMERA), "has no camera"),
        ("tum-rgbd", calibrated(room, "depth0", encoding="32FC1"), "pixels of 32FC1"),
        ("tum-rgbd", calibrated(room, "depth0", fx=30.0), "does not see what cam0 sees"),
        ("euroc", without(room, SensorKind.CAMERA), "has no camera"),
        ("vslam-lab", without(room, SensorKind.CAMERA), "has no camera"),
        ("kitti", without(room, SensorKind.CAMERA, SensorKind.LIDAR), "neither camera nor LiDAR"),
        ("kitti", calibrated(room, "cam1", rectified=False), "cam1 are not rectified"),
        ("euroc", calibrated(room, "cam0", model="double-sphere", distortion=(0.1, 0.5)), "camera model double-sphere"),
    ]
    for name, dataset, words in refusals:
        with pytest.raises(InvalidInput, match=words):
            plan_export(dataset, name, partial=True)
    with pytest.raises(NotFound, match="eurok"):
        plan_export(room, "eurok", partial=True)


def test_a_failed_export_leaves_nothing(room, tmp_path):
    broken = tmp_path / "broken"
    shutil.copytree(room.folder, broken)
    bag = broken / room.bag
    bag.write_bytes(bag.read_bytes()[:-1000])
    for name in EXPORTERS.names():
        with pytest.raises(InvalidInput):
            export(replace(room, folder=broken), name, tmp_path / "out") if name != "ros1" else export(
                calibrated(replace(room, folder=broken), "cam0", model="double-sphere"), "euroc", tmp_path / "out"
            )
    assert [path.name for path in tmp_path.iterdir()] == ["broken"]


def test_an_existing_folder_is_never_touched(room, tmp_path):
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(Conflict, match="exists already"):
        export(room, "mcap", tmp_path / "mine")
    assert (tmp_path / "mine").read_text() == "mine"


def test_kitti_refuses_cameras_that_miss_different_frames(room, tmp_path):
    """As many images in both, but the second one of cam1 is missing, and it has one more at the end."""
    cameras = (room.sensor("cam0"), room.sensor("cam1"))
    with BagWriter(tmp_path / "room.bag") as bag:
        for frame in range(6):
            for camera, missing in zip(cameras, (5, 1), strict=True):
                if frame != missing:
                    bag.image(camera, START_NS + frame * 100_000_000, np.zeros((48, 64), np.uint8), "mono8")
    source = replace(room, folder=tmp_path, sensors=cameras, groundtruth=None, reference_map=None)
    with pytest.raises(InvalidInput, match=r"message 1 of cam1 is 0\.100 s from frame 1"):
        export(source, "kitti", tmp_path / "out", partial=False)
    assert not (tmp_path / "out").exists()
