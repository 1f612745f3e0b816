"""Starts the nodes and says where their results are. Change what is marked."""

from __future__ import annotations

import sys
from pathlib import Path

from slamhive.runtime.config import RunConfig
from slamhive.runtime.ros1.app import run
from slamhive.runtime.ros1.system import PoseKind, PoseTopic, Ros1System


def make(config: RunConfig) -> Ros1System:
    """The system with the parameters of the run."""
    values = config.parameters
    return Ros1System(
        # Your launch file, in the same folder.
        launch=Path(__file__).with_name("my_slam.launch"),
        # Where poses come from: here the tree of frames; PoseKind has the other kinds, which need no frames.
        poses=PoseTopic("/tf", PoseKind.TF, parent="world", child="imu"),
        # The role whose messages are frames: each should give a pose.
        frames="points",
        # The parameter server, before the nodes start.
        parameters={"/my_slam": {"gravity": values["gravity"], "settling": values["settling"]}},
        about={"package": "my-slam", "version": "1"},
    )


if __name__ == "__main__":
    sys.exit(run(make))
