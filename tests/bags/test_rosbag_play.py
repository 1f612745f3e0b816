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


def test_it_runs_in_the_pythons_of_old_images():
    """ROS Kinetic has Python 2.7 and 3.5. An f-string is a syntax error there, and images go on without a player."""
    check = [
        str(Path(sys.executable).with_name("vermin")),
        "--target=2.7",
        "--target=3.5-",
        "--no-tips",
        "--violations",
    ]
    found = subprocess.run([*check, rosbag_play.__file__], check=False, capture_output=True, text=True, timeout=60)
    assert found.returncode == 0, found.stdout + found.stderr


def test_a_missing_rosbag_ends_with_a_message(folder, monkeypatch):
    config = folder / "config.yaml"
    config.write_text("dataset-remap: {}\n")
    monkeypatch.setattr(rosbag_play, "CONFIG", str(config))
    monkeypatch.setattr(rosbag_play, "__file__", str(folder / "rosbag_play.py"))
    monkeypatch.setenv("PATH", str(folder))
    with pytest.raises(SystemExit, match="rosbag cannot be started: No such file"):
        rosbag_play.main()
