"""VINS-Mono under the container contract: its feature tracker and its estimator, without loop closure."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from vins_mono_settings import write_settings

from slamhive.runtime.config import RunConfig
from slamhive.runtime.ros1.app import run
from slamhive.runtime.ros1.system import PoseKind, PoseTopic, Ros1System


def make(config: RunConfig) -> Ros1System:
    """The system for this run; raises InvalidInput for a camera that VINS-Mono cannot describe."""
    settings = Path(tempfile.mkdtemp(prefix="vins-mono-")) / "settings.yaml"
    write_settings(settings, config.parameters, config.algorithm_remap)
    return Ros1System(
        launch=Path(__file__).with_name("vins-mono.launch"),
        poses=PoseTopic("/vins_estimator/odometry", PoseKind.ODOMETRY),
        frames="left",
        arguments={"settings": str(settings)},
        about={"package": "VINS-Mono", "version": "90dabb5", "loop_closure": False},
    )


if __name__ == "__main__":
    sys.exit(run(make))
