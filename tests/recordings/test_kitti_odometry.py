"""KITTI odometry import: a small sequence made here, every way to break it, and the real one where it is."""

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.domain.sensors import SensorKind
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.importers.registry import IMPORTERS, detect_format
from slamhive.recordings.importing import ImportOptions, perform
from slamhive.recordings.reader import decode, inspect_bag, messages, open_bag
from slamhive.trajectory.layout import read_tum

pytestmark = pytest.mark.quick

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
FRAMES = 4
POSE = "1 0 0 {x} 0 1 0 0 0 0 1 {z}"


def silent(fraction, text):
    pass


def image(number, colour=False):
    shape = (24, 32, 3) if colour else (24, 32)
    return np.random.default_rng(number).integers(0, 256, shape, dtype=np.uint8)


@pytest.fixture
def sequence(tmp_path):
    source = tmp_path / "sequences" / "07"
    source.mkdir(parents=True)
    for camera in range(4):
        (source / f"image_{camera}").mkdir()
        for number in range(FRAMES):
            path = source / f"image_{camera}" / f"{number:06d}.png"
            assert cv2.imwrite(str(path), image(10 * camera + number, colour=camera > 1))
    (source / "velodyne").mkdir()
    for number in range(FRAMES):
        points = np.arange(20 * (number + 1), dtype="<f4")
        (source / "velodyne" / f"{number:06d}.bin").write_bytes(points.tobytes())
    (source / "times.txt").write_text("".join(f"{number * 0.1:e}\n" for number in range(FRAMES)))
    calibration = [f"P{camera}: 20 0 15.5 {-10 * camera} 0 20 11.5 0 0 0 1 0" for camera in range(4)]
    (source / "calib.txt").write_text("\n".join([*calibration, "Tr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3"]))
    (source / "poses.txt").write_text("\n".join(POSE.format(x=0, z=number) for number in range(FRAMES)))
    return source


def convert(source, folder):
    return perform(IMPORTERS.get("kitti-odometry").plan(source, ImportOptions()), folder, silent)


def test_a_sequence_becomes_a_dataset(sequence, tmp_path):
    assert detect_format(sequence) == "kitti-odometry"
    dataset = convert(sequence, tmp_path / "data" / "kitti_07")
    assert load_dataset(dataset.folder) == dataset
    counts = {topic.topic: topic.count for topic in inspect_bag(dataset.bag_path).topics}
    assert set(counts.values()) == {FRAMES}
    assert len(counts) == 9  # an image and a camera_info for each camera, the points
    with open_bag(dataset.bag_path) as reader:
        received_ns = [time_ns for _, time_ns, _ in messages(reader, dataset.bag_path)]
    # rosbag play skips what was received at 0 s.
    assert received_ns[0] == 1
    assert received_ns[-1] == 300_000_000
    right = dataset.sensor("cam1")
    assert right.T_body_sensor[3] == pytest.approx(0.5)
    assert right.calibration["encoding"] == "mono8"
    assert dataset.sensor("cam2").calibration["encoding"] == "bgr8"
    assert dataset.sensor("lidar0").T_body_sensor[:4] == (0.0, -1.0, 0.0, 0.1)
    assert dataset.groundtruth is not None
    assert not dataset.groundtruth.gravity_aligned
    truth = read_tum(dataset.folder / "groundtruth.txt")
    assert truth.positions_m[:, 2].tolist() == [0, 1, 2, 3]


def test_pixels_and_points_arrive_unchanged(sequence, tmp_path):
    dataset = convert(sequence, tmp_path / "kitti_07")
    seen: dict[str, list[Any]] = {}
    with open_bag(dataset.bag_path) as reader:
        for connection, _, raw in messages(reader, dataset.bag_path):
            seen.setdefault(connection.topic, []).append(decode(reader, dataset.bag_path, connection, raw))
    grey, colour = seen["/cam0/image_raw"][2], seen["/cam3/image_raw"][1]
    assert np.array_equal(grey.data.reshape(24, 32), image(2))
    assert np.array_equal(colour.data.reshape(24, 32, 3), image(31, colour=True))
    assert (colour.encoding, colour.step) == ("bgr8", 96)
    points = seen["/points"][1]
    assert [field.name for field in points.fields] == ["x", "y", "z", "intensity"]
    assert points.data.view("<f4").tolist() == list(range(40))
    assert seen["/cam0/image_raw"][1].header.stamp.nanosec == 100_000_000


def test_the_same_source_makes_the_same_bytes(sequence, tmp_path):
    assert convert(sequence, tmp_path / "a" / "k").checksum == convert(sequence, tmp_path / "b" / "k").checksum


@pytest.mark.parametrize("name", ["poses_kitti.txt", "poses_kitti_cam0.txt", "../../poses/07.txt", "../poses/07.txt"])
def test_poses_are_found_where_people_keep_them(sequence, tmp_path, name):
    target = sequence / name
    target.parent.mkdir(exist_ok=True)
    (sequence / "poses.txt").rename(target)
    assert convert(sequence, tmp_path / "k").groundtruth is not None


def test_without_poses_there_is_no_ground_truth(sequence, tmp_path):
    (sequence / "poses.txt").unlink()
    dataset = convert(sequence, tmp_path / "k")
    assert dataset.groundtruth is None
    assert load_dataset(dataset.folder) == dataset


def rewrite(name, pattern, replacement):
    def change(source):
        path = source / name
        text, changes = re.subn(pattern, replacement, path.read_text(), count=1)
        assert changes
        path.write_text(text)

    return change


def cut(name, size):
    return lambda source: (source / name).write_bytes((source / name).read_bytes()[:size])


def flip(name, position):
    def change(source):
        data = bytearray((source / name).read_bytes())
        data[position] ^= 0xFF
        (source / name).write_bytes(data)

    return change


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda s: (s / "times.txt").unlink(), "lacks times.txt"),
        (rewrite("times.txt", r".*\n", ""), "4 frames.*3 times"),
        (rewrite("times.txt", "1.000000e-01", "9.0"), r"times\.txt, line 3: time 0.2 s is not after.*9\.0"),
        (rewrite("times.txt", "1.000000e-01", "nan"), r"times\.txt, line 2: time nan"),
        (rewrite("times.txt", "1.000000e-01", "soon"), r"times\.txt, line 2"),
        (cut("image_0/000002.png", 300), "000002.png is truncated.*300 bytes"),
        (cut("image_1/000000.png", 0), "000000.png is empty"),
        (flip("image_0/000001.png", 200), "000001.png is corrupt"),
        (flip("image_0/000001.png", 0), "000001.png is no PNG, JPEG, PGM or PPM image"),
        (
            lambda s: cv2.imwrite(str(s / "image_1/000003.png"), image(1)[:20]),
            "000003.png is 32x20 pixels.*cam1 says 32x24",
        ),
        (lambda s: (s / "image_2/000003.png").unlink(), "image_2 holds 3 frames.*4 times"),
        (rewrite("calib.txt", "P0", "Q0"), r"calib\.txt lacks P0 \(found Q0, P1"),
        (rewrite("calib.txt", "Tr", "tr"), r"calib\.txt lacks Tr"),
        (rewrite("calib.txt", "P1: 20", "P1:"), r"calib\.txt, line 2: found 11 numbers"),
        (rewrite("calib.txt", "P1: 20", "P1: inf"), r"calib\.txt, line 2"),
        (rewrite("calib.txt", "P0: 20", "P0: 0"), "focal length of P0"),
        (rewrite("calib.txt", "P3: 20", "P3: x"), r"calib\.txt, line 4.*no numbers"),
        (rewrite("poses.txt", "0 0 0 1 2", "0 0 0 1 nan"), r"poses\.txt, line 3"),
        (rewrite("poses.txt", "0 0 0 1 2", "0 0 0 1"), r"poses\.txt, line 3"),
        (rewrite("poses.txt", "1 0 0 0 0 1", "2 0 0 0 0 1"), r"poses\.txt, line 1: no rotation.*3"),
        (rewrite("poses.txt", "1 0 0 0 0 1", "-1 0 0 0 0 1"), r"poses\.txt, line 1: no rotation"),
        (rewrite("poses.txt", r".*\n", ""), "3 poses.*4 times"),
        (cut("velodyne/000002.bin", 50), "000002.bin has 50 bytes, not a multiple of 16"),
        (cut("velodyne/000002.bin", 0), "000002.bin has 0 bytes"),
        (lambda s: (s / "velodyne/000001.bin").write_bytes(np.full(8, np.nan, "<f4").tobytes()), "point 0: found nan"),
    ],
)
def test_bad_input_is_one_clear_line_and_leaves_nothing(sequence, tmp_path, damage, problem):
    damage(sequence)
    data = tmp_path / "data"
    with pytest.raises(InvalidInput, match=problem) as caught:
        convert(sequence, data / "kitti_07")
    assert "\n" not in str(caught.value)
    assert not data.exists() or list(data.iterdir()) == []


def test_a_taken_name_conflicts(sequence, tmp_path):
    (tmp_path / "k").mkdir()
    with pytest.raises(Conflict, match="'k' exists already"):
        convert(sequence, tmp_path / "k")


def test_the_detector_names_what_is_missing(sequence, tmp_path):
    (sequence / "calib.txt").unlink()
    with pytest.raises(InvalidInput, match=r"looks like kitti-odometry.*lacks calib\.txt"):
        detect_format(sequence)
    (tmp_path / "other").mkdir()
    with pytest.raises(InvalidInput, match="no format"):
        detect_format(tmp_path / "other")


def test_an_unknown_importer_lists_the_known_ones():
    with pytest.raises(NotFound, match="kitti-odometry"):
        IMPORTERS.get("kitti-odometri")


@pytest.mark.integration
@pytest.mark.shared_data
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is absent")
def test_kitti_06_as_recorded(tmp_path):
    source = SHARED / "kitti06_stereo_51"
    dataset = convert(source, tmp_path / "kitti_06")
    counts = {topic.topic: topic.count for topic in inspect_bag(dataset.bag_path).topics}
    assert counts["/cam0/image_raw"] == counts["/cam1/image_raw"] == 51
    assert dataset.sensor("cam1").T_body_sensor[3] == pytest.approx(0.5372, abs=1e-4)
    assert (dataset.sensor("cam0").calibration["width"], dataset.sensor("cam0").calibration["height"]) == (1226, 370)
    ours, theirs = read_tum(dataset.folder / "groundtruth.txt"), read_tum(source / "groundtruth_tum.txt")
    assert np.allclose(ours.stamps_s, theirs.stamps_s, atol=1e-6)
    assert np.allclose(ours.positions_m, theirs.positions_m, atol=1e-5)
    assert np.allclose(np.abs(np.sum(ours.quats_xyzw * theirs.quats_xyzw, axis=1)), 1, atol=1e-6)


@pytest.mark.shared_data
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is absent")
def test_kitti_00_scans_without_images(tmp_path):
    dataset = convert(SHARED / "kitti00_velodyne_6", tmp_path / "kitti_00")
    assert [sensor.kind for sensor in dataset.sensors] == [SensorKind.LIDAR]
    assert inspect_bag(dataset.bag_path).topics[0].count == 6
    assert dataset.groundtruth is not None
