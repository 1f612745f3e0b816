"""Folders of LiDAR datasets mean the same to us as to the loaders of KISS-ICP, which are used on the published data."""

import shutil

import numpy as np
import pytest
from kiss_icp.datasets.kitti_raw import KITTIRawDataset
from kiss_icp.datasets.mulran import MulranDataset
from kiss_icp.datasets.nclt import NCLTDataset

from slamhive.domain.calibration import LidarLayout
from slamhive.runtime.messages import to_points
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.transforms import rotations_from_quats
from tests.recordings.format_world import convert, make_kitti_raw, recorded
from tests.recordings.range_formats import make_mulran, make_nclt

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
