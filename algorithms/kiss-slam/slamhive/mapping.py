"""KISS-SLAM under the container contract: LiDAR scans in, the sensor's trajectory after loop closures out."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from slamhive.runtime.app import run
from slamhive.runtime.bare_package import bare_package, import_bare
from slamhive.runtime.config import RunConfig
from slamhive.runtime.point_times import SweepInstant
from slamhive.runtime.scan_odometry import ScanOdometry, Sweep

# KISS-SLAM needs the registration of Open3D. Open3D's own modules need a web server and a plotting library.
native = import_bare("open3d", "pybind")
for part in ("core", "t", "geometry", "io", "utility"):
    setattr(bare_package("open3d"), part, getattr(native, part))

from kiss_slam.config import load_config  # noqa: E402
from kiss_slam.slam import KissSLAM  # noqa: E402


class KissSlam(ScanOdometry):
    """Odometry by KISS-ICP, local maps, loop closures between them, and a pose graph.

    Poses describe the LiDAR at the end of a scan, as those of KISS-ICP do; without deskewing at its middle. The live
    trajectory has no loop closures that come later; the final one has all.
    """

    package = "kiss-slam"
    also_live = True

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        settings = configure(self.values)
        if not settings.odometry.preprocessing.deskew:
            self.pose_at = SweepInstant.MIDDLE
        self._slam = KissSLAM(settings)

    def register(self, sweep: Sweep) -> np.ndarray:
        """Register the scan; the pose is that of the local map in the graph times that of the scan in the local map."""
        self._slam.process_scan(sweep.points_m, sweep.fractions)
        pose: np.ndarray = self._slam.local_map_graph.last_keypose @ self._slam.odometry.last_pose
        return pose

    def final_poses(self) -> np.ndarray:
        """The poses after the optimisation of all of them."""
        self._slam.generate_new_node()
        self._slam.local_map_graph.erase_last_local_map()
        poses, _ = self._slam.fine_grained_optimization()
        print(f"loop closures: {len(self._slam.get_closures())}", flush=True)
        return np.array(poses)

    def map_points_m(self) -> np.ndarray:
        """The local maps, each where the loop closures have put it."""
        parts = [
            part.pcd.point.positions.numpy() @ part.keypose[:3, :3].T + part.keypose[:3, 3]
            for part in self._slam.local_map_graph.local_maps()
            if part.pcd is not None
        ]
        return np.concatenate([np.empty((0, 3)), *parts])


def configure(values: dict[str, Any]) -> Any:
    """KISS-SLAM's configuration with the parameters of the run."""
    config = load_config(None)
    odometry = config.odometry
    odometry.preprocessing.deskew = values["deskew"] and bool(values.get("points_point_time_field"))
    odometry.preprocessing.max_range, odometry.preprocessing.min_range = values["max_range"], values["min_range"]
    odometry.mapping.voxel_size = values["voxel_size"]
    odometry.mapping.max_points_per_voxel = values["max_points_per_voxel"]
    odometry.registration.max_num_threads = values["max_num_threads"]
    config.local_mapper.voxel_size = values["local_map_voxel_size"]
    config.local_mapper.splitting_distance = values["splitting_distance"]
    config.loop_closer.overlap_threshold = values["overlap_threshold"]
    config.loop_closer.detector.density_map_resolution = values["density_map_resolution"]
    return config


if __name__ == "__main__":
    sys.exit(run(KissSlam))
