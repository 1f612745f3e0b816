"""Folders of datasets mean the same to us as to KISS-ICP's loaders, evalio and evo, which read the published data."""

import json
import shutil
import subprocess

import numpy as np
import pytest
from evo.tools.file_interface import read_bag_trajectory, read_tum_trajectory_file
from kiss_icp.datasets.kitti_raw import KITTIRawDataset
from kiss_icp.datasets.mulran import MulranDataset
from kiss_icp.datasets.ncd import NewerCollegeDataset
from kiss_icp.datasets.nclt import NCLTDataset
from rosbags.rosbag1 import Reader

from slamhive.domain.calibration import LidarLayout
from slamhive.recordings.importers.rosbag_benchmarks import T_BASE_LIDAR
from slamhive.runtime.messages import to_points
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.transforms import rotations_from_quats
from tests.recordings.format_world import convert, make_eth3d, make_kitti_raw, recorded
from tests.recordings.range_formats import make_mulran, make_nclt
from tests.recordings.test_import_ros import write_with_truth
from tests.recordings.test_import_ros_special import FIELDS, PERIOD_NS, START_NS, write_lidar

pytestmark = pytest.mark.quick


def poses(dataset):
    truth = read_tum(dataset.folder / "groundtruth.txt")
    made = np.tile(np.eye(4), (len(truth.stamps_s), 1, 1))
    made[:, :3, :3] = rotations_from_quats(truth.quats_xyzw)
    made[:, :3, 3] = truth.positions_m
    return truth.stamps_s, made


def relative(matrices):
    return np.linalg.inv(matrices[0]) @ matrices


def test_mulran_scans_times_and_poses(tmp_path):
    source = make_mulran(tmp_path / "KAIST01")
    dataset = convert(source, tmp_path / "made", accept_loss=True)
    (source / "Ouster").symlink_to(source / "sensor_data" / "Ouster")
    theirs = MulranDataset(source)
    lidar = dataset.sensors[0]
    cloud = to_points(recorded(dataset)[lidar.topic][0])
    points_m, sweep_fractions = theirs[0]
    np.testing.assert_allclose(cloud.points_m, points_m)
    times = LidarLayout.of(lidar).times
    since_start_s = times.since_start_s(cloud, theirs.scan_timestamps[0] * 1e-9)
    np.testing.assert_allclose(since_start_s, sweep_fractions * times.scan_duration_s, atol=1e-6)
    T_body_lidar = np.array(lidar.T_body_sensor).reshape(4, 4)
    np.testing.assert_allclose(T_body_lidar, theirs._get_calibration()[0], atol=1e-6)


@pytest.mark.integration
def test_nclt_scans_and_poses(tmp_path):
    source = make_nclt(tmp_path / "2012-01-08")
    dataset = convert(source, tmp_path / "made")
    (tmp_path / "ground_truth").mkdir()
    rows = (source / "groundtruth_2012-01-08.csv").read_text().splitlines()[1:]
    (tmp_path / "ground_truth" / "groundtruth_2012-01-08.csv").write_text("\n".join(rows) + "\n")
    theirs = NCLTDataset(source)
    lidar = dataset.sensors[0]
    T_body_lidar = np.array(lidar.T_body_sensor).reshape(4, 4)
    scans = recorded(dataset)[lidar.topic][-len(theirs) :]
    for number, message in enumerate(scans):
        point_m = to_points(message).points_m[0]  # they read the others' coordinates above 64 m as negative ones
        np.testing.assert_allclose(T_body_lidar @ [*point_m, 1.0], [*theirs[number][0][0], 1.0], atol=1e-5)
    stamps_s, matrices = poses(dataset)
    nearest = [int(np.argmin(np.abs(stamps_s - time_us * 1e-6))) for time_us in theirs.timestamps]
    np.testing.assert_allclose(matrices[nearest], theirs.gt_poses, atol=1e-4)


def test_kitti_raw_calibration_and_poses(tmp_path):
    drive = make_kitti_raw(tmp_path / "given")
    dataset = convert(drive, tmp_path / "made")
    day = tmp_path / "raw" / "2011_09_30"
    shutil.copytree(drive.parent, day)
    (day / drive.name).rename(day / "2011_09_30_drive_0016_sync")
    calibration = day / "calib_cam_to_cam.txt"
    identities = [f"R_rect_{number:02d}: 1 0 0 0 1 0 0 0 1" for number in (1, 2, 3)]
    calibration.write_text(calibration.read_text() + "\n".join(identities) + "\n")
    theirs = KITTIRawDataset(tmp_path / "raw", "4")
    _, matrices = poses(dataset)
    np.testing.assert_allclose(relative(matrices), relative(np.array(theirs.imu_poses)), atol=1e-6)
    extrinsics = {sensor.name: np.array(sensor.T_body_sensor).reshape(4, 4) for sensor in dataset.sensors}
    found = theirs.calibration
    np.testing.assert_allclose(np.linalg.inv(extrinsics["lidar0"]), found["T_velo_imu"], atol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(extrinsics["cam0"]), found["T_cam0_imu"], atol=1e-9)


# Ground truth of benchmarks in ROS bags.


def turning_poses(count=12):
    """Times in whole ns, positions, and quaternions x y z w of a path that turns in all directions."""
    draw = np.random.default_rng(3)
    quats = draw.normal(size=(count, 4))
    times_ns = START_NS + np.arange(count, dtype=np.int64) * PERIOD_NS // 2
    return times_ns, draw.normal(size=(count, 3)), quats / np.linalg.norm(quats, axis=1, keepdims=True)


def write_truth(path, columns):
    """The poses in the layout that a sequence has: seconds and nanoseconds with commas, or seconds with spaces."""
    lines = []
    for ns, position, quat in zip(*turning_poses(), strict=True):
        numbers = [f"{number:.9f}" for number in (*position, *quat)]
        if columns == 9:
            lines.append(", ".join([str(ns // 10**9), str(ns % 10**9), *numbers]))
        else:
            lines.append(" ".join([f"{ns / 1e9:.9f}", *numbers]))
    path.write_text("#sec, nsec, x, y, z, qx, qy, qz, qw\n" * (columns == 9) + "\n".join(lines) + "\n")


def test_poses_of_newer_college_are_those_of_the_lidar_as_in_kiss_icp(tmp_path):
    source = tmp_path / "01_short_experiment"
    source.mkdir()
    write_lidar(source / "rooster_0.bag", FIELDS["ouster"][0])
    write_truth(source / "registered_poses.csv", 9)
    dataset = convert(source, tmp_path / "made", "newer-college")
    T_body_lidar = np.reshape(dataset.sensors[0].T_body_sensor, (4, 4))
    ours = relative(poses(dataset)[1] @ T_body_lidar)
    theirs = NewerCollegeDataset.load_gt_poses(source / "registered_poses.csv")
    # their quaternion of 135 degrees has three digits
    np.testing.assert_allclose(ours, theirs, atol=2e-3)


def test_motion_capture_in_a_bag_of_tum_vi_is_what_evo_reads(tmp_path):
    source = tmp_path / "dataset-room1_512_16.bag"
    write_with_truth(source, "geometry_msgs/msg/TransformStamped", "/vrpn_client/raw_transform")
    times_s, ours = poses(convert(source, tmp_path / "made", "tum-vi"))
    with Reader(source) as reader:
        theirs = read_bag_trajectory(reader, "/vrpn_client/raw_transform")
    np.testing.assert_allclose(times_s, theirs.timestamps, atol=1e-6)
    np.testing.assert_allclose(ours, theirs.poses_se3, atol=1e-8)


def test_ground_truth_of_eth3d_is_what_evo_reads(tmp_path):
    source = make_eth3d(tmp_path / "plant_1")
    times_s, ours = poses(convert(source, tmp_path / "made", "eth3d"))
    theirs = read_tum_trajectory_file(source / "groundtruth.txt")
    np.testing.assert_allclose(times_s, theirs.timestamps, atol=1e-6)
    np.testing.assert_allclose(ours, theirs.poses_se3, atol=1e-8)


EVALIO_TRUTHS = """
import json, sys
from pathlib import Path
from evalio import datasets

datasets.set_data_dir(Path(sys.argv[1]))
found = {}
for name in sys.argv[2:]:
    sequence = datasets.get_sequence(name)
    truth = sequence.folder / sequence.files()[-1]
    found[name] = {"files": [str(file) for file in sequence.files()]}
    if truth.is_file():
        raw = sequence.ground_truth_raw()
        found[name]["times_ns"] = [stamp.to_nsec() for stamp in raw.stamps]
        found[name]["poses"] = [pose.to_mat().tolist() for pose in raw.poses]
print(json.dumps(found))
"""


def told_by_evalio(python, data, *names):
    command = [python, "-c", EVALIO_TRUTHS, data, *names]
    return json.loads(subprocess.run(command, check=True, capture_output=True, timeout=120).stdout)


@pytest.mark.integration
def test_ground_truth_has_the_names_and_layouts_that_evalio_knows(tmp_path, outside_python):
    layouts = {
        "newer_college_2020/short_experiment": 9,
        "newer_college_2020/parkland_mound": 8,
        "newer_college_2021/quad_easy": 9,
        "newer_college_2021/maths_hard": 9,
        "hilti_2022/construction_upper_level_1": 8,
        "hilti_2022/basement_2": 8,
    }
    named = told_by_evalio(outside_python, tmp_path, *layouts)
    for name, columns in layouts.items():
        *bags, truth = named[name]["files"]
        (tmp_path / name).mkdir(parents=True)
        write_lidar(tmp_path / name / bags[0], FIELDS["ouster"][0])
        write_truth(tmp_path / name / truth, columns)
    for name, theirs in told_by_evalio(outside_python, tmp_path, *layouts).items():
        hilti = name.startswith("hilti")
        source = tmp_path / name / theirs["files"][0] if hilti else tmp_path / name
        dataset = convert(source, tmp_path / "made" / name, "hilti-2022" if hilti else "newer-college")
        times_s, ours = poses(dataset)
        np.testing.assert_allclose(times_s, np.array(theirs["times_ns"]) / 1e9, atol=1e-6)
        if not hilti:
            # Theirs are of the frame base.
            ours = ours @ np.linalg.inv(T_BASE_LIDAR[int(name.split("_")[2][:4])])
        np.testing.assert_allclose(relative(ours), relative(np.array(theirs["poses"])), atol=1e-6)
