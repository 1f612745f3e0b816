"""SE(3)-LIO under the container contract: LiDAR scans and IMU in, the IMU's trajectory out."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from se3_lio.config import SE3LIOConfig
from se3_lio.se3_lio import SE3LIO

from slamhive.runtime.app import run
from slamhive.runtime.calibration import transform
from slamhive.runtime.config import RunConfig
from slamhive.runtime.scan_odometry import ScanOdometry, Sweep, within_range

SETTINGS = (
    "acc_noise",
    "gyr_noise",
    "ba_noise",
    "bg_noise",
    "lidar_range_noise",
    "lidar_angle_noise",
    "downsample_resolution",
    "max_iter",
    "voxel_map_resolution",
    "voxel_map_max_layer",
    "voxel_map_plane_thres",
)


class Se3LioOdometry(ScanOdometry):
    """Feeds each scan with the IMU samples that lead to its end. Poses describe the IMU at the end of the scan."""

    package = "se3-lio"

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        settings: dict[str, Any] = {key: self.values[key] for key in SETTINGS}
        self._odometry = SE3LIO(SE3LIOConfig(**settings), transform(self.values, "imu", "points"))

    def register(self, sweep: Sweep) -> np.ndarray | None:
        """Register the scan; without IMU samples it has no pose."""
        kept = within_range(sweep.points_m, self.values["min_range"], self.values["max_range"])
        if not len(sweep.imu) or not kept.any():
            return None
        state, _ = self._odometry.register_frame(
            sweep.points_m[kept], sweep.offsets_s[kept], sweep.imu_acc_first, sweep.start_s
        )
        return np.asarray(state.pose)


if __name__ == "__main__":
    sys.exit(run(Se3LioOdometry))
