"""LeGO-LOAM under the container contract: LiDAR sweeps in, the sensor's trajectory out."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slamhive.base.errors import InvalidInput
from slamhive.runtime.config import RunConfig
from slamhive.runtime.ros1.app import run
from slamhive.runtime.ros1.system import PoseKind, PoseTopic, Ros1System, sweep_parameters, sweep_times

AXES = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
"""LeGO-LOAM's axes: x to the left, y up, z forward."""

SETTINGS = ("beams", "columns", "lowest_deg", "ring_distance_deg", "edge_threshold", "surf_threshold")


def make(config: RunConfig) -> Ros1System:
    """The nodes of LeGO-LOAM with the parameters of the run."""
    values = config.parameters
    times = sweep_times(values)
    return Ros1System(
        launch=Path(__file__).with_name("lego_loam.launch"),
        poses=PoseTopic("/integrated_to_init", PoseKind.ODOMETRY),
        frames="points",
        arguments={
            **{key: values[key] for key in SETTINGS},
            "ground_beams": ground_beams(values),
            "scan_period_s": times.scan_duration_s,
            "minimum_range_m": values["minimum_range"],
            "mapping_interval_s": values["mapping_interval"],
            "loop_closure": int(values["loop_closure"]),
        },
        parameters=sweep_parameters(values, rotation=values["rotation"]),
        # The timestamp is that of the sweep's message; odometry and mapping give the pose at its end.
        pose_delay_s=times.end_s(0.0),
        R_system_sensor=AXES,
        map_topic="/laser_cloud_surround",
        about={"package": "LeGO-LOAM", "version": "896a7a9"},
    )


def ground_beams(values: Mapping[str, Any]) -> int:
    """Lowest beams that may see the ground. Raises InvalidInput for rings that are not counted upwards."""
    lowest_deg, distance_deg = float(values["lowest_deg"]), float(values["ring_distance_deg"])
    if distance_deg <= 0:
        raise InvalidInput(
            f"the rings of this LiDAR are counted downwards (ring_distance_deg {distance_deg:g})",
            "LeGO-LOAM wants the lowest ring first",
        )
    below_horizon = int(-lowest_deg / distance_deg)
    chosen = int(values["ground_beams"]) or below_horizon
    return max(1, min(chosen, int(values["beams"]) - 1))


if __name__ == "__main__":
    sys.exit(run(make))
