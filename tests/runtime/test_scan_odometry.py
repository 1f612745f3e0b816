"""What adapters of LiDAR odometry get and leave: sweeps, IMU samples, timestamps of poses, the map."""

from __future__ import annotations

from importlib.metadata import version

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.messages import PointCloud
from slamhive.runtime.point_times import SweepInstant
from slamhive.runtime.scan_odometry import ScanOdometry, Sweep, within_range
from slamhive.runtime.trajectory import Poses, Trajectories

pytestmark = pytest.mark.quick

TIMED = {"points_rate_hz": 10.0, "points_point_time_field": "t", "points_point_time_unit": "ms", "points_stamp": "end"}


class Odometry(ScanOdometry):
    """Keeps the sweeps; has no pose for the second."""

    package = "numpy"

    def __init__(self, values):
        super().__init__(RunConfig("a", "d", values))
        self.sweeps: list[Sweep] = []

    def register(self, sweep):
        self.sweeps.append(sweep)
        return None if len(self.sweeps) == 2 else np.eye(4)

    def map_points_m(self):
        return np.ones((5, 3))


def frame(number, stamp_s, imu_s=(), points=3):
    cloud = PointCloud(np.full((points, 3), float(number)), {"t": np.array([0.0, 50.0, 120.0])[:points]})
    imu = np.array([[t, *range(6)] for t in imu_s], dtype=np.float64).reshape(-1, 7)
    return Frame(number, stamp_s, 0.0, 0.0, {"points": cloud}, imu)


def test_a_sweep_has_its_times_and_the_imu_samples_up_to_its_end():
    odometry = Odometry(TIMED)
    assert odometry.process(frame(0, 10.0, [9.9, 10.0, 10.01]))
    assert not odometry.process(frame(1, 10.1, [10.1]))
    first, second = odometry.sweeps
    assert (first.start_s, first.end_s) == pytest.approx((9.9, 10.0))
    assert first.fractions == pytest.approx([0.0, 0.5, 1.0]), "what is later than the sweep counts as its end"
    assert first.offsets_s == pytest.approx([0.0, 0.05, 0.12])
    assert first.imu[:, 0].tolist() == [9.9, 10.0]
    assert second.imu[:, 0].tolist() == [10.01, 10.1]
    assert first.imu_acc_first[0].tolist() == [9.9, 3, 4, 5, 0, 1, 2]


def test_imu_samples_of_empty_sweeps_go_to_the_next_one():
    odometry = Odometry(TIMED)
    assert not odometry.process(frame(0, 10.0, [9.95], points=0))
    assert odometry.process(frame(1, 10.1, [10.05]))
    assert odometry.sweeps[0].imu[:, 0].tolist() == [9.95, 10.05]


@pytest.mark.parametrize(("instant", "pose_s"), [("start", 9.9), ("middle", 9.95), ("end", 10.0)])
def test_poses_have_the_instant_that_the_adapter_states(instant, pose_s):
    odometry = Odometry(TIMED)
    odometry.pose_at = SweepInstant(instant)
    for number in range(3):
        odometry.process(frame(number, 10.0 + 0.1 * number))
    poses = odometry.finish()
    assert isinstance(poses, Poses)
    assert poses.stamps_s == pytest.approx([pose_s, pose_s + 0.2]), "the second sweep has no pose"
    assert odometry.about() == {"package": "numpy", "version": version("numpy")}


def test_poses_that_are_corrected_later_replace_the_live_ones(monkeypatch):
    odometry = Odometry({"points_rate_hz": 10.0})
    for number in range(3):
        odometry.process(frame(number, 10.0 + 0.1 * number))
    corrected = np.stack([np.eye(4), 2 * np.eye(4)])
    monkeypatch.setattr(odometry, "final_poses", lambda: corrected)
    only = odometry.finish()
    assert isinstance(only, Poses)
    assert only.T_world_sensor is corrected
    monkeypatch.setattr(Odometry, "also_live", True)
    both = odometry.finish()
    assert isinstance(both, Trajectories)
    assert both.main.T_world_sensor is corrected
    assert both.others["live"].T_world_sensor.tolist() == [np.eye(4).tolist()] * 2
    assert both.others["live"].stamps_s.tolist() == both.main.stamps_s.tolist()
    monkeypatch.setattr(odometry, "final_poses", lambda: corrected[:1])
    with pytest.raises(InvalidInput, match="numpy has 1 poses for 2 registered sweeps"):
        odometry.finish()


def test_a_lidar_without_times_gives_none():
    odometry = Odometry({"points_rate_hz": 10.0})
    odometry.process(frame(0, 10.0))
    (sweep,) = odometry.sweeps
    assert sweep.since_start_s is None
    assert len(sweep.fractions) == 0
    assert sweep.offsets_s.tolist() == [0, 0, 0]


@pytest.mark.parametrize("asked", [True, False])
def test_the_map_is_saved_if_asked(asked, tmp_path, monkeypatch):
    monkeypatch.setenv("SLAMHIVE_RESULT", str(tmp_path))
    Odometry({"points_rate_hz": 10.0, "save_map": asked}).finish()
    assert (tmp_path / "Map.pcd").is_file() == asked


def test_points_outside_of_a_range_are_told_apart():
    points_m = np.array([[0.1, 0, 0], [0, 3, 4], [0, 0, 9]])
    assert within_range(points_m, 0.3, 5.0).tolist() == [False, True, False]
