"""LOAM under the container contract: LiDAR sweeps in, the sensor's trajectory out."""

from __future__ import annotations

import sys
from pathlib import Path

from slamhive.runtime.config import RunConfig
from slamhive.runtime.ros1.app import run
from slamhive.runtime.ros1.system import PoseKind, PoseTopic, Ros1System, sweep_parameters, sweep_times

AXES = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
"""LOAM's axes: x to the left, y up, z forward."""


def make(config: RunConfig) -> Ros1System:
    """The nodes of LOAM with the parameters of the run."""
    values = config.parameters
    times = sweep_times(values)
    period = {"scanPeriod": times.scan_duration_s}
    return Ros1System(
        launch=Path(__file__).with_name("loam.launch"),
        poses=PoseTopic("/integrated_to_init", PoseKind.ODOMETRY),
        frames="points",
        parameters={
            **sweep_parameters(values, rotation=values["rotation"]),
            "/multiScanRegistration": {
                **period,
                "nScanRings": int(values["points_beams"]),
                "minVerticalAngle": values["lowest_deg"],
                "maxVerticalAngle": values["highest_deg"],
                "minimumRange": values["minimum_range"],
                # Upstream leaves out the first two seconds.
                "systemDelay": 0,
            },
            "/laserOdometry": {**period, "ioRatio": values["mapping_every"]},
            "/laserMapping": {
                **period,
                "cornerFilterSize": values["line_resolution"],
                "surfaceFilterSize": values["plane_resolution"],
            },
        },
        # The timestamp is that of the sweep's message; LOAM integrates to the end of the sweep.
        pose_delay_s=times.end_s(0.0),
        R_system_sensor=AXES,
        map_topic="/laser_cloud_surround",
        about={"package": "loam_velodyne", "version": "25db5dd"},
    )


if __name__ == "__main__":
    sys.exit(run(make))
