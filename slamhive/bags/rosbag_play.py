"""Plays the ROS 1 bag beside this file, with the remaps of the run's configuration.

A copy of this file lies in every dataset folder: algorithm images with ROS inside start it as
``python3 /slamhive/dataset/rosbag_play.py``, or with ``python`` in older ones. It runs in their Python, 2.7 or 3.5 at
the oldest, and needs only PyYAML.
"""

from __future__ import print_function

import glob
import os
import sys

import yaml

CONFIG = "/slamhive/config.yaml"


def play_command(folder, config):
    """The command that plays the only bag in ``folder``; ``dataset-remap`` maps the topic seen to the recorded one."""
    bags = sorted(glob.glob(os.path.join(str(folder), "*.bag")))
    if len(bags) != 1:
        sys.exit("expected one .bag file in {}, found {}".format(folder, len(bags)))
    command = ["rosbag", "play", bags[0]]
    for seen, recorded in sorted((config.get("dataset-remap") or {}).items()):
        if seen != recorded:
            command.append("{}:={}".format(recorded, seen))
    playback = (config.get("slam-hive") or {}).get("playback") or {}
    rate = float(playback.get("rate") or 1.0)
    if rate != 1.0:
        command.append("--rate={:g}".format(rate))
    return command + ["--clock"]


def main():
    """Replace this process by ``rosbag play``."""
    with open(CONFIG) as stream:
        config = yaml.safe_load(stream)
    command = play_command(os.path.dirname(os.path.abspath(__file__)), config)
    try:
        os.execvp(command[0], command)
    except OSError as error:
        sys.exit("{} cannot be started: {}".format(command[0], error.strerror))


if __name__ == "__main__":
    main()
