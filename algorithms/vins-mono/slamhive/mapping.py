"""VINS-Mono under the container contract: its feature tracker and its estimator, without loop closure."""

from __future__ import annotations

import sys
from pathlib import Path

from vins_mono_settings import write_settings

from slamhive.runtime.config import RunConfig
from slamhive.runtime.ros1.app import run
from slamhive.runtime.ros1.system import Ros1System
from slamhive.runtime.vins import vins_system

LAUNCH = Path(__file__).with_name("vins-mono.launch")


def make(config: RunConfig) -> Ros1System:
    """The system for this run; raises InvalidInput for a camera that VINS-Mono cannot describe."""
    about = {"package": "VINS-Mono", "version": "90dabb5"}
    return vins_system(config, LAUNCH, write_settings, about, every_frame=config.parameters["freq"] == 0)


if __name__ == "__main__":
    sys.exit(run(make))
