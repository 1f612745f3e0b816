"""RKO-LIO under the container contract: LiDAR scans and IMU in, the IMU's trajectory out."""

from __future__ import annotations

import sys

import numpy as np
from rko_lio.config import LIOConfig
from rko_lio.lio import LIO
from rko_lio.rko_lio_pybind import InputError

from slamhive.runtime.app import run
from slamhive.runtime.calibration import transform
from slamhive.runtime.config import RunConfig
from slamhive.runtime.scan_odometry import ScanOdometry, Sweep
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


class RkoLioOdometry(ScanOdometry):
    """Feeds IMU samples up to a scan's end, then the scan.

    The base frame, whose poses RKO-LIO estimates, is set to the IMU's. A pose belongs to the scan's end
    (``register_scan(..., end_time_ns)`` is what ``poses_with_timestamps`` reports).
    """

    package = "rko_lio"

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        self._T_imu_lidar = transform(self.values, "imu", "points")
        self._lio = LIO(LIOConfig(**{key: self.values[key] for key in SETTINGS}))

    def register(self, sweep: Sweep) -> np.ndarray | None:
        """Register the scan with the IMU samples that lead to its end; one that is refused has no pose."""
        for row in sweep.imu:
            self._lio.add_imu_measurement(row[4:7], row[1:4], round(row[0] * 1e9), np.eye(4))
        sweep_start_ns = round(sweep.start_s * 1e9)
        stamps_ns = sweep_start_ns + np.rint(sweep.offsets_s * 1e9).astype(np.int64)
        end_ns = max(round(sweep.end_s * 1e9), int(stamps_ns.max()))
        try:
            self._lio.register_scan(sweep.points_m, stamps_ns, self._T_imu_lidar, sweep_start_ns, end_ns)
        except InputError as error:
            print(f"scan {sweep.number} refused: {error}", flush=True)
            return None
        return np.asarray(self._lio.pose())

    def map_points_m(self) -> np.ndarray:
        """The part of the map that RKO-LIO keeps, within max_range of the last pose."""
        return np.asarray(self._lio.map_point_cloud())

    def finish(self) -> Poses:
        """One pose of the IMU for each registered scan, with RKO-LIO's own timestamps; and the map if asked for."""
        super().finish()
        stamps_ns, rows = self._lio.poses_with_timestamps()
        poses = [transform_from(row[:3], row[3:7]) for row in np.asarray(rows, dtype=np.float64).reshape(-1, 7)]
        return Poses(np.asarray(stamps_ns, dtype=np.float64) * 1e-9, np.array(poses).reshape(-1, 4, 4))


if __name__ == "__main__":
    sys.exit(run(RkoLioOdometry))
