"""VINS-Fusion under the container contract, in three modes: which one follows from the sensors of the run."""

from __future__ import annotations

import sys
from pathlib import Path

from vins_fusion_settings import write_settings

from slamhive.runtime.config import RunConfig
from slamhive.runtime.ros1.app import run
from slamhive.runtime.ros1.system import Ros1System
from slamhive.runtime.vins import vins_system

LAUNCH = Path(__file__).with_name("vins-fusion.launch")


def make(config: RunConfig) -> Ros1System:
    """The system for this run; raises InvalidInput for a camera that VINS-Fusion cannot describe."""
    about = {"package": "VINS-Fusion", "version": "be55a93"}
    every_frame = not config.parameters["multiple_thread"] or config.parameters["feature_every"] == 1
    return vins_system(config, LAUNCH, write_settings, about, every_frame=every_frame)


if __name__ == "__main__":
    sys.exit(run(make))
