"""RKO-LIO under the container contract: LiDAR scans and IMU in, the IMU's trajectory out."""

from __future__ import annotations

import sys
from importlib.metadata import version
from typing import Any

import numpy as np
from rko_lio.config import LIOConfig
from rko_lio.lio import LIO
from rko_lio.rko_lio_pybind import InputError

from slamhive.runtime.app import run
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.point_times import PointTimes
from slamhive.runtime.trajectory import Poses, transform_from

SETTINGS = (
    "deskew",
    "max_iterations",
    "voxel_size",
    "max_range",
    "min_range",
    "convergence_criterion",
    "max_correspondence_distance",
    "max_num_threads",
    "initialization_phase",
    "max_expected_jerk",
    "double_downsample",
    "min_beta",
)


class RkoLioOdometry:
    """Feeds IMU samples up to a scan's end, then the scan.

    The base frame, whose poses RKO-LIO estimates, is set to the IMU's. A pose belongs to the scan's end
    (``register_scan(..., end_time_ns)`` is what ``poses_with_timestamps`` reports).
    """

    def __init__(self, config: RunConfig) -> None:
        values = config.parameters
        self._times = PointTimes.of(values, float(values["points_rate_hz"]), "points", "points_")
        T_body_imu = np.array(values["imu_T_body_sensor"], dtype=np.float64).reshape(4, 4)
        T_body_lidar = np.array(values["points_T_body_sensor"], dtype=np.float64).reshape(4, 4)
        self._T_imu_lidar = np.linalg.inv(T_body_imu) @ T_body_lidar
        self._lio = LIO(LIOConfig(**{key: values[key] for key in SETTINGS}))
        self._refused = 0

    def process(self, frame: Frame) -> bool:
        """Register the scan with the IMU samples that lead to its end; one that is empty or refused has no pose."""
        identity = np.eye(4)
        for row in frame.imu:
            self._lio.add_imu_measurement(row[4:7], row[1:4], round(row[0] * 1e9), identity)
        cloud = frame.points("points")
        if len(cloud.points_m) == 0:
            return False
        sweep_start_ns = round(self._times.start_s(frame.stamp_s) * 1e9)
        offsets_s = self._times.since_start_s(cloud, frame.stamp_s)
        stamps_ns = sweep_start_ns + np.rint(offsets_s * 1e9).astype(np.int64)
        start_ns = min(sweep_start_ns, int(stamps_ns.min()))
        end_ns = max(sweep_start_ns + round(self._times.scan_duration_s * 1e9), int(stamps_ns.max()))
        try:
            self._lio.register_scan(cloud.points_m, stamps_ns, self._T_imu_lidar, start_ns, end_ns)
        except InputError as error:
            self._refused += 1
            print(f"scan {frame.number} refused: {error}", flush=True)
            return False
        return True

    def finish(self) -> Poses:
        """One pose of the IMU for each registered scan."""
        stamps_ns, rows = self._lio.poses_with_timestamps()
        poses = [transform_from(row[:3], row[3:7]) for row in np.asarray(rows, dtype=np.float64).reshape(-1, 7)]
        return Poses(np.asarray(stamps_ns, dtype=np.float64) * 1e-9, np.array(poses).reshape(-1, 4, 4))

    def about(self) -> dict[str, Any]:
        """The package that ran."""
        return {"package": "rko_lio", "version": version("rko_lio")}


if __name__ == "__main__":
    sys.exit(run(RkoLioOdometry))
