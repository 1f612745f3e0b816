"""A-LOAM under the container contract: LiDAR sweeps in, the sensor's trajectory out."""

from __future__ import annotations

import sys
from pathlib import Path

from slamhive.runtime.config import RunConfig
from slamhive.runtime.ros1.app import run
from slamhive.runtime.ros1.system import PoseKind, PoseTopic, Ros1System, middle_delay_s, sweep_parameters

SETTINGS = ("minimum_range", "mapping_skip_frame", "mapping_line_resolution", "mapping_plane_resolution")


def make(config: RunConfig) -> Ros1System:
    """The nodes of A-LOAM with the parameters of the run."""
    values = config.parameters
    return Ros1System(
        launch=Path(__file__).with_name("aloam.launch"),
        poses=PoseTopic("/aft_mapped_to_init", PoseKind.ODOMETRY),
        frames="points",
        parameters={
            **sweep_parameters(values, rotation=values["rotation"]),
            "/scan_line": int(values["points_beams"]),
            **{f"/{key}": values[key] for key in SETTINGS},
        },
        # A-LOAM does not deskew: a sweep stands for its middle.
        pose_delay_s=middle_delay_s(values),
        every_frame=values["mapping_skip_frame"] == 1,
        drop_lines=("^drop lidar frame in mapping",),
        map_topic="/laser_cloud_map",
        about={"package": "A-LOAM", "version": "e51f88c"},
    )


if __name__ == "__main__":
    sys.exit(run(make))
