"""Plays the ROS 1 bag beside this file, with the remaps of the run's configuration.

A copy of this file lies in every dataset folder: algorithm images with ROS inside start it as
``python3 /slamhive/dataset/rosbag_play.py``, or with ``python`` in older ones. It runs in their Python, 2.7 or 3.5 at
the oldest, and needs only PyYAML. Images start it in the background and go on without it, so it reports a failure in
``playback.json``, which fails the run. Its own arguments are passed on to ``rosbag play``.
"""

import glob
import json
import os
import signal
import subprocess
import sys

CONFIG = "/slamhive/config.yaml"
REPORT = "/slamhive/result/playback.json"
ENDED_BY_IMAGE = (0, -signal.SIGINT, -signal.SIGTERM, -signal.SIGHUP)
"""How a player ends that played all, or that its image stopped."""
FATAL = "[FATAL]"
"""Marks a line on why the player ended early. ``rosbag play`` is a script that hides the exit code of the player."""


def play_command(folder, config):
    """The command that plays the only bag in ``folder``; ``dataset-remap`` maps the topic seen to the recorded one."""
    bags = sorted(glob.glob(os.path.join(str(folder), "*.bag")))
    if len(bags) != 1:
        give_up("expected one .bag file in {}, found {}".format(folder, len(bags)))
    command = ["rosbag", "play", bags[0]]
    for seen, recorded in sorted((config.get("dataset-remap") or {}).items()):
        if seen != recorded:
            command.append("{}:={}".format(recorded, seen))
    playback = (config.get("slam-hive") or {}).get("playback") or {}
    rate = float(playback.get("rate") or 1.0)
    if rate != 1.0:
        command.append("--rate={:g}".format(rate))
    return command + ["--clock"]


def give_up(problem):
    """Report that nothing was played, and end."""
    try:
        with open(REPORT, "w") as report:
            json.dump({"error": problem}, report)
    except (IOError, OSError):
        pass  # outside of a container
    sys.exit(problem)


def read_config():
    """The configuration of the run. An old image may have PyYAML for one of its Pythons only."""
    try:
        import yaml  # noqa: PLC0415 - reported if it is missing
    except ImportError:
        give_up("{} has no PyYAML".format(sys.executable))
    try:
        with open(CONFIG) as stream:
            config = yaml.safe_load(stream)
    except (IOError, OSError, ValueError, yaml.YAMLError) as error:
        give_up("{} cannot be read: {}".format(CONFIG, " ".join(str(error).split())))
    if not isinstance(config, dict):
        give_up("{} holds no configuration".format(CONFIG))
    return config


def play(command):
    """Play, pass on signals and errors; a player that fails is reported with its last line."""
    try:
        player = subprocess.Popen(command, stderr=subprocess.PIPE)
    except OSError as error:
        give_up("{} cannot be started: {}".format(command[0], error.strerror))
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _frame: player.send_signal(number))
        signal.siginterrupt(number, False)
    assert player.stderr is not None
    last = fatal = ""
    for raw in iter(player.stderr.readline, b""):
        line = raw.decode("utf-8", "replace")
        sys.stderr.write(line.encode("ascii", "replace").decode("ascii"))
        last = line.strip() or last
        if FATAL in line:
            fatal = line.split("]: ")[-1].split("\x1b")[0].strip() or last
    player.stderr.close()
    code = player.wait()
    if fatal:
        give_up("rosbag play failed: {}".format(fatal))
    if code not in ENDED_BY_IMAGE:
        give_up("rosbag play ended with exit code {}{}".format(code, ": " + last if last else ""))


def main():
    """Play the bag with the remaps and the rate of the run."""
    play(play_command(os.path.dirname(os.path.abspath(__file__)), read_config()) + sys.argv[1:])


if __name__ == "__main__":
    main()
