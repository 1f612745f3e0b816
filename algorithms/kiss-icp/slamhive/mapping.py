"""KISS-ICP under the container contract: LiDAR scans in, the sensor's trajectory out."""

from __future__ import annotations

import sys
from importlib.metadata import version
from typing import Any

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.config.parser import load_config
from kiss_icp.kiss_icp import KissICP

from slamhive.runtime.app import run
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.paths import run_paths
from slamhive.runtime.pcd import write_pcd
from slamhive.runtime.point_times import PointTimes
from slamhive.runtime.trajectory import Poses


class KissIcpOdometry:
    """Registers each scan against the map.

    KISS-ICP removes the motion within a scan: its ``Preprocessor`` moves each point to where it would be at the
    normalised timestamp 1.0. That is the end of the scan, so each pose is that of the sensor at the end of the scan.
    """

    def __init__(self, config: RunConfig) -> None:
        values = config.parameters
        self._times = PointTimes.of(values, float(values["points_rate_hz"]), "points", "points_")
        self._odometry = KissICP(configure(values))
        self._save_map = bool(values["save_map"])
        self._stamps_s: list[float] = []
        self._poses: list[np.ndarray] = []

    def process(self, frame: Frame) -> bool:
        """Register the scan; an empty one has no pose."""
        cloud = frame.points("points")
        if len(cloud.points_m) == 0:
            return False
        normalised = np.empty(0)
        if self._times.field:
            normalised = self._times.since_start_s(cloud, frame.stamp_s) / self._times.scan_duration_s
        self._odometry.register_frame(cloud.points_m, np.clip(normalised, 0.0, 1.0))
        self._stamps_s.append(self._pose_stamp_s(frame.stamp_s))
        self._poses.append(self._odometry.last_pose.copy())
        return True

    def finish(self) -> Poses:
        """One pose for each scan, and the map if it was asked for."""
        if self._save_map:
            write_pcd(run_paths().result / "Map.pcd", self._odometry.local_map.point_cloud())
        return Poses(np.array(self._stamps_s), np.array(self._poses).reshape(-1, 4, 4))

    def about(self) -> dict[str, Any]:
        """The package that ran."""
        return {"package": "kiss-icp", "version": version("kiss-icp")}

    def _pose_stamp_s(self, stamp_s: float) -> float:
        deskewed = bool(self._times.field) and self._odometry.config.data.deskew
        # Without deskewing a scan stands for its middle.
        return self._times.end_s(stamp_s) - (0.0 if deskewed else 0.5 * self._times.scan_duration_s)


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
