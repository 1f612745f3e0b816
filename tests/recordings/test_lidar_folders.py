"""LiDAR datasets that lie in folders of scans: NCLT and MulRan."""

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import LidarLayout, PointOrder
from slamhive.runtime.messages import to_points
from slamhive.runtime.point_times import PointTimes, SweepInstant
from slamhive.trajectory.layout import read_tum
from tests.recordings.format_world import (
    convert,
    cut,
    plan,
    recorded,
    remove,
    rewrite,
)
from tests.recordings.range_formats import MULRAN_START_NS, NCLT_START_US, make_mulran, make_nclt

pytestmark = pytest.mark.quick


def test_an_nclt_session_is_turned_so_that_z_points_up(tmp_path):
    dataset = convert(make_nclt(tmp_path / "2012-01-08"), tmp_path / "made")
    lidar, imu, gnss = dataset.sensors
    seen = recorded(dataset)
    cloud = to_points(seen[lidar.topic][1])
    T_body_lidar = np.array(lidar.T_body_sensor).reshape(4, 4)
    in_body_m = cloud.points_m @ T_body_lidar[:3, :3].T + T_body_lidar[:3, 3]
    assert in_body_m == pytest.approx(np.array([[0, -1, 1], [0.01, 100, -100]]), abs=1e-4)
    assert T_body_lidar[2, 2] > 0.99
    assert (cloud.field("intensity").tolist(), cloud.field("laser").tolist()) == ([7, 255], [31, 0])
    assert LidarLayout.of(lidar).times == PointTimes(0.1, stamp=SweepInstant.MIDDLE)
    assert T_body_lidar[:3, 3] == pytest.approx([0.002, 0.004, 0.957])
    sample = seen[imu.topic][0]
    assert (sample.angular_velocity.x, sample.linear_acceleration.z) == (0.01, -9.8)
    assert sample.header.stamp.nanosec == NCLT_START_US % 1_000_000 * 1000
    fixes = seen[gnss.topic]
    assert len(fixes) == 3
    assert fixes[0].latitude == pytest.approx(42.2939, abs=1e-3)
    truth = read_tum(dataset.folder / "groundtruth.txt")
    assert truth.positions_m[0].tolist() == [1, -2, -3]
    assert len(truth.stamps_s) == 7


def test_covariances_of_nclt_are_the_uncertainty_of_its_poses(tmp_path):
    source = make_nclt(tmp_path / "2012-01-08")
    names = [f"{first}{second}" for place, first in enumerate("xyzrph") for second in "xyzrph"[place:]]
    for time_us, sigma_m in ((NCLT_START_US, 0.1), (NCLT_START_US + 400_000, 0.5)):
        row = {"xx": sigma_m**2, "yy": 4 * sigma_m**2, "zz": 9 * sigma_m**2}
        numbers = ",".join(f"{row.get(name, 7.0)}" for name in names)
        with (source / "cov_2012-01-08.csv").open("a") as file:
            file.write(f"{time_us},{numbers}\n")
    made = plan(source)
    assert made.truth is not None
    since_s = made.truth.times_s - NCLT_START_US * 1e-6
    assert made.truth.sigmas_m == pytest.approx(np.outer(0.1 + since_s, [1, 2, 3]), abs=1e-6)
    assert any(note.startswith("cov_2012-01-08.csv is the uncertainty of the ground truth") for note in made.notes)
    (source / "cov_2012-01-08.csv").write_text(f"{NCLT_START_US},-1{',0' * 20}\n")
    with pytest.raises(InvalidInput, match=r"cov_2012-01-08\.csv, line 1: a variance is negative"):
        plan(source)


def test_gravity_points_down_in_the_body_of_nclt(tmp_path):
    """An accelerometer at rest measures +g along the axis that points up; that of NCLT points down."""
    imu = convert(make_nclt(tmp_path / "s"), tmp_path / "made").sensors[1]
    R_body_imu = np.array(imu.T_body_sensor).reshape(4, 4)[:3, :3]
    assert (R_body_imu @ [0, 0, -9.8])[2] == pytest.approx(9.8)


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (
            cut(f"velodyne_sync/{NCLT_START_US}.bin", 15),
            "has 15 bytes, not a multiple of 8 .x, y, z, inten",
        ),
        (cut(f"velodyne_sync/{NCLT_START_US}.bin", 0), "has 0 bytes"),
        (rewrite("ms25.csv", "-9.8", "down"), "ms25.csv, line 1: 'down' is not a number"),
        (rewrite("ms25.csv", ",0.01,0.02,0.00", ""), "ms25.csv, line 1: 7 columns, not 10"),
        (rewrite("gps.csv", "(?s).*", "1326030975726043,0,0,nan,nan,nan\n"), "gps.csv has no finite row"),
        (rewrite("groundtruth_2012-01-08.csv", ",1,2,3", ",1,two,3"), "line 2: 'two' is not a number"),
        (
            lambda source: (source / "velodyne_sync" / "first.bin").write_bytes(b""),
            "first.bin is not named by a timestamp",
        ),
        (lambda source: (source / "groundtruth_other.csv").write_text(""), "has 2 files groundtruth_"),
    ],
)
def test_a_mistake_in_a_session_is_one_clear_line(tmp_path, damage, problem):
    source = make_nclt(tmp_path / "2012-01-08")
    damage(source)
    with pytest.raises(InvalidInput, match=problem):
        convert(source, tmp_path / "made", "nclt")
    assert not (tmp_path / "made").exists()


def test_a_mulran_sequence_gets_rings_and_times_from_the_order_of_points(tmp_path):
    source = make_mulran(tmp_path / "KAIST01")
    made = plan(source, accept_loss=True)
    assert "1 scans do not have 64 x 1024 points and are left out" in made.notes
    assert any("no pose of the IMU" in note for note in made.notes)
    dataset = convert(source, tmp_path / "made", accept_loss=True)
    lidar, imu, gnss = dataset.sensors
    seen = recorded(dataset)
    assert len(seen[lidar.topic]) == 2
    cloud = to_points(seen[lidar.topic][0])
    layout = LidarLayout.of(lidar)
    assert (layout.ring_field, layout.point_order) == ("ring", PointOrder.COLUMNS)
    since_start_s = layout.times.since_start_s(cloud, MULRAN_START_NS * 1e-9)
    assert since_start_s[[0, 63, 64, -1]] == pytest.approx([0, 0, 0.1 / 1024, 0.1 * 1023 / 1024])
    assert cloud.field(layout.ring_field)[[0, 63, 64]].tolist() == [0, 63, 0]
    assert seen[lidar.topic][0].header.stamp.nanosec == MULRAN_START_NS % 10**9
    sample = seen[imu.topic][0]
    assert (sample.angular_velocity.z, sample.linear_acceleration.z) == (0.03, 9.8)
    fix = seen[gnss.topic][0]
    assert (fix.longitude, fix.position_covariance.tolist()) == (127.4, [4, 0, 0, 0, 4, 0, 0, 0, 9])
    truth = read_tum(dataset.folder / "groundtruth.txt")
    assert truth.positions_m[0].tolist() == [353000.5, 4026000.25, 20]
    assert truth.quats_xyzw[0] == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)])


def test_an_imu_file_with_orientations_only_is_left_out(tmp_path):
    source = make_mulran(tmp_path / "KAIST01")
    path = source / "sensor_data" / "xsens_imu.csv"
    path.write_text("".join(",".join(line.split(",")[:8]) + "\n" for line in path.read_text().splitlines()))
    assert [sensor.name for sensor in plan(source, accept_loss=True).sensors] == ["lidar0", "gnss0"]


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (cut(f"sensor_data/Ouster/{MULRAN_START_NS}.bin", 16), "1 of 3 files in .*Ouster have 64 x 1024 points"),
        (rewrite("sensor_data/xsens_imu.csv", r"(\n[^\n]*),1,2,3", r"\1"), "xsens_imu.csv, line 2: 14 columns, not 17"),
        (rewrite("sensor_data/gps.csv", "36.3", "nan"), "gps.csv, line 1: 'nan' is not finite"),
        (rewrite("global_pose.csv", "0,-1,0", "0,-2,0"), "global_pose.csv, line 1: the matrix is no rotation"),
        (rewrite("global_pose.csv", "(?s).*", "1,0,-1,0,1,1,0,0,1,0,0,1,1\n"), "the clocks do not meet"),
    ],
)
def test_a_mistake_in_a_mulran_sequence_is_one_clear_line(tmp_path, damage, problem):
    source = make_mulran(tmp_path / "KAIST01")
    damage(source)
    with pytest.raises(InvalidInput, match=problem):
        plan(source, "mulran")


def test_without_ground_truth_it_says_so(tmp_path):
    source = make_mulran(tmp_path / "KAIST01")
    remove("global_pose.csv")(source)
    made = plan(source, accept_loss=True)
    assert made.truth is None
    assert "there is no ground truth: runs get no ATE" in made.notes
