"""The play script that existing algorithm images start."""

import subprocess
import sys
from pathlib import Path

import pytest

from slamhive.bags import rosbag_play


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "room.bag").touch()
    return tmp_path


def test_remaps_turn_around(folder):
    config = {"dataset-remap": {"/camera/left": "/cam0/image_raw", "/imu0": "/imu0"}}
    command = rosbag_play.play_command(folder, config)
    assert command == ["rosbag", "play", str(folder / "room.bag"), "/cam0/image_raw:=/camera/left", "--clock"]


def test_older_configurations_have_neither_remap_nor_rate(folder):
    assert rosbag_play.play_command(folder, {"dataset-remap": None}) == [
        "rosbag",
        "play",
        str(folder / "room.bag"),
        "--clock",
    ]


def test_the_rate_is_passed_on(folder):
    config = {"slam-hive": {"playback": {"mode": "realtime", "rate": 0.5}}}
    assert "--rate=0.5" in rosbag_play.play_command(folder, config)


@pytest.mark.parametrize("bags", [0, 2])
def test_anything_but_one_bag_ends_with_a_message(tmp_path, bags):
    for number in range(bags):
        (tmp_path / f"{number}.bag").touch()
    with pytest.raises(SystemExit, match="expected one"):
        rosbag_play.play_command(tmp_path, {})


def test_it_runs_without_the_package():
    script = Path(rosbag_play.__file__)
    code = f"import runpy; runpy.run_path({str(script)!r}, run_name='copy')"
    subprocess.run([sys.executable, "-I", "-c", code], check=True, cwd="/", timeout=30)
    assert "slamhive" not in "".join(line for line in script.read_text().splitlines() if line.startswith("import"))
