"""GenZ-ICP under the container contract: LiDAR scans in, the sensor's trajectory out."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from genz_icp.config import GenZConfig, load_config
from genz_icp.genz_icp import GenZICP

from slamhive.runtime.app import run
from slamhive.runtime.config import RunConfig
from slamhive.runtime.point_times import SweepInstant
from slamhive.runtime.scan_odometry import ScanOdometry, Sweep

SECTIONS = {
    "data": ("max_range", "min_range"),
    "mapping": (
        "voxel_size",
        "map_cleanup_radius",
        "desired_num_voxelized_points",
        "planarity_threshold",
        "max_points_per_voxel",
    ),
    "registration": ("max_num_iterations", "convergence_criterion", "max_num_threads"),
    "adaptive_threshold": ("initial_threshold", "min_motion_th"),
}
"""The parameters of the run by the sections of GenZ-ICP's configuration."""


class GenzIcpOdometry(ScanOdometry):
    """Registers each scan against the map, with weights for planar and other points.

    With or without deskewing a pose describes the middle of the scan: GenZ-ICP moves each point to where it would be
    at the normalised timestamp 0.5.
    """

    package = "genz-icp"
    pose_at = SweepInstant.MIDDLE

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        self._odometry = GenZICP(configure(self.values))

    def register(self, sweep: Sweep) -> np.ndarray:
        """Register the scan."""
        self._odometry.register_frame(sweep.points_m, sweep.fractions)
        pose: np.ndarray = self._odometry.last_pose
        return pose

    def map_points_m(self) -> np.ndarray:
        """The points of the voxel map within ``map_cleanup_radius`` of the last pose."""
        return self._odometry.local_map.point_cloud()


def configure(values: dict[str, Any]) -> GenZConfig:
    """GenZ-ICP's configuration with the parameters of the run."""
    config = load_config(None)
    config.data.deskew = values["deskew"] and bool(values.get("points_point_time_field"))
    for section, keys in SECTIONS.items():
        for key in keys:
            setattr(getattr(config, section), key, values[key])
    return config


if __name__ == "__main__":
    sys.exit(run(GenzIcpOdometry))
