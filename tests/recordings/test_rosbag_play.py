"""The play script that existing algorithm images start."""

import ast
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from slamhive.recordings import rosbag_play
from slamhive.recordings.staging import current_script


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
    text = Path(rosbag_play.__file__).read_bytes()
    assert text.isascii()  # Python 2.7 refuses anything else without a line that names the encoding
    tree = ast.parse(text, feature_version=(3, 5))
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.JoinedStr | ast.AnnAssign | ast.Nonlocal)]


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"a: [", "config.yaml cannot be read: while parsing"),
        (b"\xff\xfe\xff", "config.yaml cannot be read: "),
        (b"", "config.yaml holds no configuration"),
        (b"- 1", "config.yaml holds no configuration"),
        (None, "config.yaml cannot be read: .*No such file"),
    ],
)
def test_a_configuration_that_cannot_be_read_is_reported_in_one_line(report, content, problem):
    config = Path(rosbag_play.CONFIG)
    config.unlink() if content is None else config.write_bytes(content)
    with pytest.raises(SystemExit, match=problem):
        rosbag_play.main()
    said = json.loads(report.read_text())["error"]
    assert "\n" not in said


@pytest.fixture
def report(folder, monkeypatch):
    """Where the player reports, with a configuration and a folder of programs."""
    config = folder / "config.yaml"
    config.write_text("dataset-remap: {}\n")
    monkeypatch.setattr(rosbag_play, "CONFIG", str(config))
    monkeypatch.setattr(rosbag_play, "REPORT", str(folder / "playback.json"))
    monkeypatch.setattr(rosbag_play, "__file__", str(folder / "rosbag_play.py"))
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)
    return folder / "playback.json"


def rosbag(folder, script):
    program = folder / "rosbag"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)


@pytest.fixture
def handlers():
    """The player takes signals over, as long as it lives."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    kept = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, kept, strict=True):
        signal.signal(number, handler)


def test_a_missing_rosbag_is_reported(report, monkeypatch):
    monkeypatch.setenv("PATH", str(report.parent))
    with pytest.raises(SystemExit, match="rosbag cannot be started: No such file"):
        rosbag_play.main()
    assert json.loads(report.read_text())["error"].startswith("rosbag cannot be started")


def test_a_player_that_fails_is_reported_with_its_last_line(report, handlers, capfd):
    rosbag(report.parent, "echo 'Error opening file' >&2; exit 3")
    with pytest.raises(SystemExit, match="exit code 3: Error opening file"):
        rosbag_play.main()
    assert json.loads(report.read_text()) == {"error": "rosbag play ended with exit code 3: Error opening file"}
    assert "Error opening file" in capfd.readouterr().err


def test_a_player_whose_exit_code_rosbag_hides_is_reported(report, handlers, capfd):
    rosbag(report.parent, r"printf '\033[31m[FATAL] [1795527808.288]: Error parsing header\033[0m\nbye\n' >&2")
    with pytest.raises(SystemExit, match="rosbag play failed: Error parsing header"):
        rosbag_play.main()
    assert json.loads(report.read_text()) == {"error": "rosbag play failed: Error parsing header"}


@pytest.mark.parametrize("script", ["exit 0", "kill -INT $$"])
def test_a_player_that_played_all_or_was_ended_by_its_image_reports_nothing(report, handlers, script):
    rosbag(report.parent, script)
    rosbag_play.main()
    assert not report.exists()


def test_an_image_without_pyyaml_is_reported(report, monkeypatch):
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(SystemExit, match="has no PyYAML"):
        rosbag_play.main()
    assert "PyYAML" in json.loads(report.read_text())["error"]


def test_copies_of_earlier_versions_give_way(tmp_path):
    shipped = Path(rosbag_play.__file__)
    old, other = tmp_path / "old.py", tmp_path / "other.py"
    old.write_text(shipped.read_text().splitlines()[0] + '\n\nOld."""\nprint(f"{1}")\n')
    other.write_text("print('written by somebody else')\n")
    assert current_script(old) == shipped
    assert current_script(other) == other
