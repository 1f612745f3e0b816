"""Pelorus under the container contract: LiDAR scans and IMU in, the IMU's trajectory out."""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
import pelorus

from slamhive.runtime.app import run
from slamhive.runtime.calibration import transform
from slamhive.runtime.config import RunConfig
from slamhive.runtime.point_times import SweepInstant
from slamhive.runtime.scan_odometry import ScanOdometry, Sweep, within_range
from slamhive.runtime.trajectory import transform_from

POLL_S = 0.001
FIRST_WAIT_S = 0.05
"""How long to wait for poses while the IMU initialises, which gives none: longer waits would drop the scans after."""
UNKNOWN = [0.0] * 9
"""A covariance that is not known, as ROS messages state it."""


class PelorusOdometry(ScanOdometry):
    """Hands over IMU samples and scans, and waits for the pose, which another thread computes.

    Pelorus takes points in the frame of the IMU. Its poses have the timestamp of the start of the scan; they fit the
    middle of the scan, see the README.
    """

    package = "pelorus"
    pose_at = SweepInstant.MIDDLE

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        self._T_imu_lidar = transform(self.values, "imu", "points")
        self._handle = pelorus.Handle()
        self._longest_wait_s = min(FIRST_WAIT_S, self.values["longest_wait"])

    def register(self, sweep: Sweep) -> np.ndarray | None:
        """Register the scan; it has no pose while the IMU initialises, or if none comes in time."""
        for row in sweep.imu:
            self._handle.add_imu(
                **stamp_of(row[0]),
                orientation=[1.0, 0.0, 0.0, 0.0],
                orientation_covariance=UNKNOWN,
                angular_velocity=row[1:4].tolist(),
                angular_velocity_covariance=UNKNOWN,
                linear_acceleration=row[4:7].tolist(),
                linear_acceleration_covariance=UNKNOWN,
            )
        kept = within_range(sweep.points_m, self.values["min_range"], self.values["max_range"])
        if not kept.any():
            return None
        points_m = sweep.points_m[kept] @ self._T_imu_lidar[:3, :3].T + self._T_imu_lidar[:3, 3]
        offsets_ns = np.rint(sweep.offsets_s[kept] * 1e9)
        number = self._handle.add_pointcloud(np.column_stack((points_m, offsets_ns)), **stamp_of(sweep.start_s))
        return self._pose_of(number)

    def _pose_of(self, number: int) -> np.ndarray | None:
        """The pose of the scan with this number, for which we wait at most ``longest_wait``."""
        until_s = time.monotonic() + self._longest_wait_s
        while time.monotonic() < until_s:
            result = self._handle.try_recv()
            if result is None:
                time.sleep(POLL_S)
                continue
            self._longest_wait_s = self.values["longest_wait"]
            if result["scan_id"] == number:
                w, x, y, z = result["orientation"]
                return transform_from(np.array(result["position"]), np.array([x, y, z, w]))
        return None


def stamp_of(time_s: float) -> dict[str, Any]:
    """A time as Pelorus takes it."""
    seconds, nanoseconds = divmod(round(time_s * 1e9), 10**9)
    return {"timestamp_sec": seconds, "timestamp_nanosec": nanoseconds}


if __name__ == "__main__":
    sys.exit(run(PelorusOdometry))
