"""Plays the ROS 1 bag beside this file, with the remaps of the run's configuration.

A copy of this file lies in every dataset folder: algorithm images with ROS inside start it as
``python3 /slamhive/dataset/rosbag_play.py``. It runs in their Python, 3.6 at the oldest, and needs only PyYAML.
"""

import os
import sys
from pathlib import Path
from typing import Any

import yaml

CONFIG = Path("/slamhive/config.yaml")


def play_command(folder: Path, config: "dict[str, Any]") -> "list[str]":
    """The command that plays the only bag in ``folder``; ``dataset-remap`` maps the topic seen to the recorded one."""
    bags = sorted(folder.glob("*.bag"))
    if len(bags) != 1:
        sys.exit(f"expected one .bag file in {folder}, found {len(bags)}")
    command = ["rosbag", "play", str(bags[0])]
    for seen, recorded in (config.get("dataset-remap") or {}).items():
        if seen != recorded:
            command.append(f"{recorded}:={seen}")
    playback = (config.get("slam-hive") or {}).get("playback") or {}
    rate = float(playback.get("rate") or 1.0)
    if rate != 1.0:
        command.append(f"--rate={rate:g}")
    return [*command, "--clock"]


def main() -> None:
    """Replace this process by ``rosbag play``."""
    config = yaml.safe_load(CONFIG.read_text())
    command = play_command(Path(__file__).resolve().parent, config)
    os.execvp(command[0], command)  # noqa: S606 - a list of arguments, no shell


if __name__ == "__main__":
    main()
