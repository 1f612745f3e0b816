"""Starts ROS 2 and the run: SLAM Hive starts this file with the plain python3 of the image."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

RUNTIME = "/opt/slamhive-runtime"


def command(distribution: str, script: Path) -> list[str]:
    """The shell that sets the variables of ROS 2 and becomes the run."""
    setup = f"/opt/ros/{distribution}/setup.sh"
    run = f"PYTHONPATH={RUNTIME}:$PYTHONPATH exec python3 {shlex.quote(str(script))}"
    return ["/bin/sh", "-c", f". {shlex.quote(setup)} && {run}"]


if __name__ == "__main__":
    found = command(os.environ.get("ROS_DISTRO", "jazzy"), Path(__file__).with_name("ros2_run.py"))
    sys.stdout.flush()
    os.execv(found[0], found)
