"""The main program of a mapping script, in a process of its own, as executors start it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from slamhive.domain.run import FailureReason
from slamhive.run_folder.outcome import inspect_trajectory
from slamhive.runtime.config import RunConfig, to_yaml
from tests.runtime.runtime_samples import write_bag

pytestmark = pytest.mark.integration

SCRIPT = """
import sys
import numpy as np
from slamhive.runtime.app import run
from slamhive.runtime.trajectory import Poses

class Counter:
    def __init__(self, config):
        self.stamps = []
    def process(self, frame):
        self.stamps.append(frame.stamp_s)
        return {tracked}
    def finish(self):
        kept = self.stamps if {keep} else []
        return Poses(np.array(kept), np.tile(np.eye(4), (len(kept), 1, 1)))
    def about(self):
        return {{"package": "counter"}}

sys.exit(run(Counter))
"""


def start(
    tmp_path: Path, keep: bool = True, topic: str = "/cam0", tracked: str = "None"
) -> subprocess.CompletedProcess[str]:
    dataset, result = tmp_path / "dataset", tmp_path / "result"
    dataset.mkdir()
    result.mkdir()
    write_bag(dataset / "small.bag", 10)
    config = RunConfig("a", "d", algorithm_remap={"left": "/left"}, dataset_remap={"/left": topic})
    (tmp_path / "config.yaml").write_text(to_yaml(config))
    (tmp_path / "mapping.py").write_text(SCRIPT.format(keep=keep, tracked=tracked))
    places = {
        "SLAMHIVE_CONFIG": str(tmp_path / "config.yaml"),
        "SLAMHIVE_DATASET": str(dataset),
        "SLAMHIVE_RESULT": str(result),
        "PYTHONPATH": str(Path.cwd()),
    }
    command = [sys.executable, str(tmp_path / "mapping.py")]
    return subprocess.run(
        command, env={**os.environ, **places}, capture_output=True, text=True, timeout=30, check=False
    )


def test_a_run_leaves_everything_the_contract_names(tmp_path: Path) -> None:
    ended = start(tmp_path)
    assert (ended.returncode, ended.stderr) == (0, "")
    result = tmp_path / "result"
    names = {"about.json", "finished", "frames.csv", "playback.json", "progress.json", "traj.txt"}
    assert {path.name for path in result.iterdir()} == names
    assert len((result / "traj.txt").read_text().splitlines()) == 11
    assert json.loads((result / "progress.json").read_text()) == {
        "fraction": 1.0,
        "frames": 10,
        "dropped": 0,
        "untracked_s": None,
    }
    assert json.loads((result / "playback.json").read_text())["frames_total"] == 10
    newest = max(result.iterdir(), key=lambda path: path.stat().st_mtime_ns)
    assert newest.name == "finished"


def test_a_failure_is_one_line_and_never_finished(tmp_path: Path) -> None:
    ended = start(tmp_path, topic="/no")
    assert ended.returncode == 1
    assert len(ended.stderr.splitlines()) == 1
    assert "no topic" in ended.stderr
    assert not (tmp_path / "result" / "finished").exists()


def test_an_algorithm_that_finds_no_pose_leaves_an_empty_trajectory(tmp_path: Path) -> None:
    ended = start(tmp_path, keep=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "0 poses from 10 frames" in ended.stdout
    check = inspect_trajectory(tmp_path / "result" / "traj.txt")
    assert (check.poses, check.problem) == (None, FailureReason.EMPTY_TRAJECTORY)


@pytest.mark.parametrize(("tracked", "last"), [("frame.number < 4", 6), ("False", 9), ("frame.number != 5", 0)])
def test_time_without_a_pose_is_told_in_seconds_of_the_recording(tmp_path: Path, tracked: str, last: int) -> None:
    start(tmp_path, tracked=tracked)
    stamps_s = [float(line.split()[0]) for line in (tmp_path / "result" / "traj.txt").read_text().splitlines()[1:]]
    told = json.loads((tmp_path / "result" / "progress.json").read_text())
    assert told["untracked_s"] == pytest.approx(stamps_s[-1] - stamps_s[-1 - last], abs=1e-3)
