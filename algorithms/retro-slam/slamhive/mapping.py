"""RETRO-SLAM under the container contract: LiDAR scans in, the sensor's trajectory after loop closures out."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from retro_slam.config import load_config
from retro_slam.slam import RetroSLAM

from slamhive.runtime.app import run
from slamhive.runtime.config import RunConfig
from slamhive.runtime.point_times import SweepInstant
from slamhive.runtime.scan_odometry import ScanOdometry, Sweep


class RetroSlam(ScanOdometry):
    """Odometry by KISS-ICP, submaps, loop closures that are looked for again later, and a pose graph.

    Poses describe the LiDAR at the end of a scan, as those of KISS-ICP do; without deskewing at its middle.
    """

    package = "retro-slam"

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        settings = configure(self.values)
        if not settings.odometry.preprocessing.deskew:
            self.pose_at = SweepInstant.MIDDLE
        self._slam = RetroSLAM(settings)

    def register(self, sweep: Sweep) -> np.ndarray:
        """Register the scan. RETRO-SLAM gives its poses at the end only, so this one is replaced."""
        self._slam.process_scan(sweep.points_m, sweep.fractions)
        return np.eye(4)

    def final_poses(self) -> np.ndarray:
        """The poses in the pose graph. Those of the last submap get there when the system ends."""
        self._slam.exit()
        print(f"loop closures: {len(self._slam.loop_closures)}", flush=True)
        poses: np.ndarray = self._slam.poses
        return poses


def configure(values: dict[str, Any]) -> Any:
    """RETRO-SLAM's configuration with the parameters of the run."""
    config = load_config(None)
    odometry, mapper = config.odometry, config.local_mapper
    odometry.preprocessing.deskew = values["deskew"] and bool(values.get("points_point_time_field"))
    odometry.preprocessing.max_range, odometry.preprocessing.min_range = values["max_range"], values["min_range"]
    odometry.mapping.voxel_size = values["voxel_size"]
    odometry.mapping.max_points_per_voxel = values["max_points_per_voxel"]
    odometry.registration.max_num_threads = values["max_num_threads"]
    mapper.submap_voxel_size = mapper.localmap_voxel_size = values["submap_voxel_size"]
    mapper.submap_splitting_distance = values["submap_splitting_distance"]
    mapper.localmap_splitting_distance = values["localmap_splitting_distance"]
    config.loop_closer.fitness_threshold = values["fitness_threshold"]
    config.loop_closer.detector.density_map_resolution = values["density_map_resolution"]
    return config


if __name__ == "__main__":
    sys.exit(run(RetroSlam))
