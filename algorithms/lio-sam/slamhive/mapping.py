"""LIO-SAM under the container contract: LiDAR sweeps and IMU samples in, the LiDAR's trajectory out."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.runtime.config import RunConfig
from slamhive.runtime.ros1.app import run
from slamhive.runtime.ros1.system import PoseKind, PoseTopic, Ros1System, middle_delay_s, sweep_parameters

SETTINGS = {
    "N_SCAN": "beams",
    "Horizon_SCAN": "columns",
    "lidarMinRange": "minimum_range",
    "imuAccNoise": "accelerometer_noise",
    "imuGyrNoise": "gyroscope_noise",
    "imuAccBiasN": "accelerometer_bias_noise",
    "imuGyrBiasN": "gyroscope_bias_noise",
    "imuGravity": "gravity",
    "imuOrientation": "imu_orientation",
    "edgeThreshold": "edge_threshold",
    "surfThreshold": "surf_threshold",
    "odometrySurfLeafSize": "odometry_plane_resolution",
    "mappingCornerLeafSize": "mapping_line_resolution",
    "mappingSurfLeafSize": "mapping_plane_resolution",
    "surroundingkeyframeAddingDistThreshold": "keyframe_distance",
    "mappingProcessInterval": "mapping_interval",
    "numberOfCores": "threads",
    "loopClosureEnableFlag": "loop_closure",
}
"""Parameters of the package by the names that LIO-SAM gives them."""

MAP_SETTINGS = {"globalMapVisualizationPoseDensity": 1.0, "globalMapVisualizationLeafSize": 0.2}
"""How finely the published map is sampled, in m; upstream's 10 m and 1 m are for roads."""


def make(config: RunConfig) -> Ros1System:
    """The nodes of LIO-SAM with the parameters of the run."""
    values = config.parameters
    return Ros1System(
        launch=Path(__file__).with_name("lio_sam.launch"),
        poses=PoseTopic("/lio_sam/mapping/odometry", PoseKind.ODOMETRY),
        keyframes=PoseTopic("/lio_sam/mapping/path", PoseKind.PATH),
        frames="points",
        parameters={**sweep_parameters(values), "/lio_sam": settings(values)},
        # Upstream compensates the rotation during a sweep, but not the translation: positions are those at its middle.
        pose_delay_s=middle_delay_s(values),
        every_frame=values["mapping_interval"] == 0,
        # LIO-SAM makes the map only if somebody listens.
        map_topic="/lio_sam/mapping/map_global" if values["save_map"] else None,
        about={"package": "LIO-SAM", "version": "0be1fbe"},
    )


def settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters that the nodes read below ``/lio_sam``, except for the topics."""
    T_lidar_imu = np.array(values["T_lidar_imu"], dtype=float).reshape(4, 4)
    R_lidar_imu = T_lidar_imu[:3, :3].ravel().tolist()
    return {
        **{name: values[key] for name, key in SETTINGS.items()},
        **MAP_SETTINGS,
        # All LiDARs come as this one: rings, times and units are unified before.
        "sensor": "velodyne",
        "extrinsicRot": R_lidar_imu,
        "extrinsicRPY": R_lidar_imu,
        "extrinsicTrans": T_lidar_imu[:3, 3].tolist(),
        "imuRPYWeight": values["imu_orientation_weight"] if values["imu_orientation"] else 0.0,
    }


if __name__ == "__main__":
    sys.exit(run(make))
