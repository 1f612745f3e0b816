"""GenZ-LIO under the container contract: LiDAR scans and IMU in, the IMU's trajectory out."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from genz_lio import Config, GenZLIO

from slamhive.runtime.app import run
from slamhive.runtime.calibration import transform
from slamhive.runtime.config import RunConfig
from slamhive.runtime.scan_odometry import ScanOdometry, Sweep

SECTIONS = {
    "preprocess": {"min_range": "blind_min", "max_range": "blind_max"},
    "mapping": {
        "voxel_size": "voxel_size",
        "down_sample_size": "down_sample_size",
        "max_iteration": "max_iteration",
        "map_range": "map_range",
    },
    "adaptive_voxelization": {
        "adaptive_voxelization": "enable",
        "min_points": "min_points",
        "max_points": "max_points",
    },
    "hybrid_metric": {"hybrid_metric": "enable", "lambda_po": "lambda_po"},
    "noise_model": {key: key for key in ("ranging_cov", "angle_cov", "acc_cov", "gyr_cov", "b_acc_cov", "b_gyr_cov")},
}
"""The parameters of the run by the sections of GenZ-LIO's configuration, with their names there."""


class GenzLioOdometry(ScanOdometry):
    """Feeds each scan with the IMU samples that lead to its end. Poses describe the IMU at the end of the scan."""

    package = "genz-lio"

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        self._odometry = GenZLIO(configure(self.values))

    def register(self, sweep: Sweep) -> np.ndarray | None:
        """Register the scan; while the IMU initialises, and without IMU samples, it has no pose."""
        if not len(sweep.imu):
            return None
        result = self._odometry.register_scan(
            sweep.points_m, sweep.start_s, sweep.end_s, sweep.imu_acc_first, timestamps=sweep.offsets_s
        )
        return np.asarray(result.pose) if result.valid else None


def configure(values: dict[str, Any]) -> Config:
    """GenZ-LIO's configuration with the parameters of the run."""
    config = Config()
    config.max_threads = values["max_num_threads"]
    for section, names in SECTIONS.items():
        for key, name in names.items():
            setattr(getattr(config, section), name, values[key])
    T_imu_lidar = transform(values, "imu", "points")
    config.mapping.extrinsic_r, config.mapping.extrinsic_t = T_imu_lidar[:3, :3], T_imu_lidar[:3, 3]
    config.preprocess.scan_rate = round(values["points_rate_hz"])
    return config


if __name__ == "__main__":
    sys.exit(run(GenzLioOdometry))
