"""Odometry by small_gicp under the container contract: LiDAR scans in, the sensor's trajectory out."""

from __future__ import annotations

import sys

import numpy as np
import small_gicp

from slamhive.runtime.app import run
from slamhive.runtime.config import RunConfig
from slamhive.runtime.point_times import SweepInstant
from slamhive.runtime.scan_odometry import ScanOdometry, Sweep, within_range

FEWEST_POINTS = 10
"""With fewer points after thinning out, a scan cannot be registered."""


class SmallGicpOdometry(ScanOdometry):
    """Registers each scan against a map of Gaussian voxels, as small_gicp's benchmark of scan-to-model odometry does.

    The library does not compensate the motion within a scan, so a scan stands for its middle.
    """

    package = "small_gicp"
    pose_at = SweepInstant.MIDDLE

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        values = self.values
        self._map = small_gicp.GaussianVoxelMap(values["voxel_size"])
        self._map.set_lru(horizon=values["map_horizon_scans"], clear_cycle=10)
        self._threads = int(values["max_num_threads"])
        self._pose = self._last = np.eye(4)
        self._is_first = True

    def register(self, sweep: Sweep) -> np.ndarray | None:
        """Register the scan, starting from the motion of the scan before."""
        values = self.values
        kept = sweep.points_m[within_range(sweep.points_m, values["min_range"], values["max_range"])]
        points, _ = small_gicp.preprocess_points(
            kept, values["downsampling_resolution"], values["num_neighbors"], self._threads
        )
        if points.size() < FEWEST_POINTS:
            return None
        if not self._is_first:
            guess = self._pose @ np.linalg.inv(self._last) @ self._pose
            result = small_gicp.align(
                self._map,
                points,
                init_T_target_source=guess,
                max_correspondence_distance=values["max_correspondence_distance"],
                num_threads=self._threads,
                max_iterations=values["max_num_iterations"],
            )
            self._last, self._pose = self._pose, result.T_target_source
        self._is_first = False
        self._map.insert(points, self._pose)
        return self._pose

    def map_points_m(self) -> np.ndarray:
        """The means of the voxels that were seen in the last ``map_horizon_scans`` scans."""
        return self._map.voxel_points()[:, :3]


if __name__ == "__main__":
    sys.exit(run(SmallGicpOdometry))
