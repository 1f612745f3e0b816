"""KISS-ICP under the container contract: LiDAR scans in, the sensor's trajectory out."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.config.parser import load_config
from kiss_icp.kiss_icp import KissICP

from slamhive.runtime.app import run
from slamhive.runtime.config import RunConfig
from slamhive.runtime.point_times import SweepInstant
from slamhive.runtime.scan_odometry import ScanOdometry, Sweep


class KissIcpOdometry(ScanOdometry):
    """Registers each scan against the map.

    KISS-ICP removes the motion within a scan: its ``Preprocessor`` moves each point to where it would be at the
    normalised timestamp 1.0. That is the end of the scan, so each pose is that of the sensor at the end of the scan.
    """

    package = "kiss-icp"

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        self._odometry = KissICP(configure(self.values))
        if not self._odometry.config.data.deskew:
            self.pose_at = SweepInstant.MIDDLE  # a scan whose motion stays in it stands for its middle

    def register(self, sweep: Sweep) -> np.ndarray:
        """Register the scan."""
        self._odometry.register_frame(sweep.points_m, sweep.fractions)
        pose: np.ndarray = self._odometry.last_pose
        return pose

    def map_points_m(self) -> np.ndarray:
        """The points of the voxel map within ``max_range`` of the last pose."""
        points_m: np.ndarray = self._odometry.local_map.point_cloud()
        return points_m


def configure(values: dict[str, Any]) -> KISSConfig:
    """KISS-ICP's configuration with the parameters of the run."""
    config = load_config(None)
    config.data.max_range = values["max_range"]
    config.data.min_range = values["min_range"]
    config.data.deskew = values["deskew"] and bool(values.get("points_point_time_field"))
    config.mapping.voxel_size = values["voxel_size"]
    config.mapping.max_points_per_voxel = values["max_points_per_voxel"]
    config.registration.max_num_iterations = values["max_num_iterations"]
    config.registration.convergence_criterion = values["convergence_criterion"]
    config.registration.max_num_threads = values["max_num_threads"]
    config.adaptive_threshold.initial_threshold = values["initial_threshold"]
    config.adaptive_threshold.min_motion_th = values["min_motion_th"]
    return config


if __name__ == "__main__":
    sys.exit(run(KissIcpOdometry))
