"""Two commands from a recording to an ATE: ``dataset import`` and ``run --evaluate``, for ROS 1, ROS 2 and MCAP."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamhive.cli import main
from tests.recordings.storages import convert_to
from tests.services.recorded_track import POINTS, SCANS, make_recorded_track
from tests.services.tiny_project import environment, make_project

pytestmark = pytest.mark.integration

MAPPING = """
import sys
import numpy as np
from slamhive.runtime.app import run
from slamhive.runtime.trajectory import Poses

class Bend:
    '''Moves along a bend by the timestamps of the scans that the player delivers; 5 cm too high every other scan.'''

    def __init__(self, config):
        self.stamps_s, self.positions_m = [], []

    def process(self, frame):
        assert len(frame.points("points").points_m) == POINTS
        self.stamps_s.append(frame.stamp_s)
        time_s = frame.stamp_s - 100.0
        self.positions_m.append((2.0 * time_s, time_s**2, 0.05 * (len(self.stamps_s) % 2)))
        return True

    def finish(self):
        poses = np.tile(np.eye(4), (len(self.stamps_s), 1, 1))
        poses[:, :3, 3] = self.positions_m
        return Poses(np.array(self.stamps_s), poses)

    def about(self):
        return {}

sys.exit(run(Bend))
"""
STORAGES = {"ros1": None, "ros2": "sqlite3-file-zstd", "mcap": "plain-mcap-zstd"}
"""What each format is made with: rosbags' own writer and converter."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of commands in a project whose algorithm reads the recording, and the recordings by format."""
    folder = tmp_path_factory.mktemp("world")
    project = make_project(folder / "project")
    mapping = project / "algorithms" / "tiny" / "slamhive" / "mapping.py"
    mapping.write_text(textwrap.dedent(MAPPING).replace("POINTS", str(POINTS)))
    track = make_recorded_track(folder / "source")
    for name, storage in STORAGES.items():
        made = track if storage is None else convert_to(track, folder / name, storage)
        (folder / f"take-{name}").symlink_to(made.bag_path.parent)
    rows = (f"{100 + i / 10:.6f} {i / 5} {(i / 10) ** 2} 0 0 0 0 1" for i in range(SCANS))
    (folder / "truth.txt").write_text("\n".join(rows) + "\n")
    return {**environment(project, folder / "data"), "WORLD": str(folder)}


def command(world: dict[str, str], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> str:
    for key, value in world.items():
        monkeypatch.setenv(key, value)
    ended = CliRunner().invoke(main, arguments)
    assert ended.exit_code == 0, ended.stderr
    return ended.stdout


def source_of(world: dict[str, str], name: str) -> str:
    folder = Path(world["WORLD"]) / f"take-{name}"
    found = {"ros1": "track.bag", "ros2": "d", "mcap": "d.mcap"}[name]
    return str(folder / found)


@pytest.mark.parametrize("name", list(STORAGES))
def test_two_commands_give_an_ate(world, monkeypatch, name):
    truth = str(Path(world["WORLD"]) / "truth.txt")
    shown = command(
        world, monkeypatch, "dataset", "import", source_of(world, name), "--name", name, "--groundtruth", truth
    )
    assert f"{name}: {name}, 1.9 s" in shown
    assert "lidar0" in shown
    ran = command(world, monkeypatch, "run", "tiny", name, "--evaluate", "--wait", "--json")
    (run,) = json.loads(ran)
    # every other pose is 5 cm too high, so after alignment all are 2.5 cm off
    assert run["metrics"]["ate.rmse"]["value"] == pytest.approx(0.025, abs=1e-3)


SLOW_IMPORT = """
import sys, time
from slamhive.recordings import importing
from slamhive.cli import main
def wait(*_, **__):
    print("copied", flush=True)
    time.sleep(60)
importing.NewDataset.seal = wait
sys.argv = ["slamhive", "dataset", "import", sys.argv[1], "--name", "killed"]
main()
"""


def test_a_killed_import_leaves_nothing_and_works_again(world, monkeypatch):
    source = source_of(world, "mcap")
    killed = subprocess.Popen(
        [sys.executable, "-c", SLOW_IMPORT, source], env={**os.environ, **world}, stdout=subprocess.PIPE, text=True
    )
    assert killed.stdout is not None
    while "copied" not in killed.stdout.readline():
        assert killed.poll() is None
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    killed.stdout.close()
    assert "killed" not in command(world, monkeypatch, "dataset", "list")
    command(world, monkeypatch, "dataset", "import", source, "--name", "killed")
    assert "killed" in command(world, monkeypatch, "dataset", "list")
    datasets = Path(world["SLAMHIVE_DATA"]) / "datasets"
    assert not list(datasets.glob(".*.partial"))


def test_two_topics_for_one_sensor_are_refused(world, monkeypatch):
    for key, value in world.items():
        monkeypatch.setenv(key, value)
    source = source_of(world, "ros1")
    ended = CliRunner().invoke(main, ["dataset", "import", source, "--topic", "lidar0=/a", "--topic", "lidar0=/b"])
    assert ended.exit_code == 1
    assert "--topic names two topics for lidar0: /a and /b" in ended.stderr
