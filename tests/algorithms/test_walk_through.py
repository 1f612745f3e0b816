"""docs/add-an-algorithm.md, executed: its files are written as they stand, and the algorithm they make tracks."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.project import project_root
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.packages.image_context import stage_context
from slamhive.recordings.room import RoomOptions, render_room
from slamhive.trajectory.layout import read_tum
from tests.algorithms.algorithm_runs import run_mapping

pytestmark = pytest.mark.integration

BLOCK = re.compile(r'^```\w+ title="(?P<path>[^"]+)"\n(?P<text>.*?)^```$', re.MULTILINE | re.DOTALL)


@pytest.mark.integration
def test_the_files_of_the_walk_through_make_a_working_algorithm(tmp_path: Path) -> None:
    document = (project_root() / "docs" / "add-an-algorithm.md").read_text(encoding="utf-8")
    files = {match["path"]: match["text"] for match in BLOCK.finditer(document)}
    assert len(files) == 3
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text, encoding="utf-8")
    package = tmp_path / "algorithms" / "tiny-rgbd"
    (algorithm,) = load_algorithms(package)
    assert stage_context(algorithm.package, project_root(), tmp_path / "context").path.is_dir()

    options = RoomOptions(duration_s=3.0, width=320, height=240, camera_rate_hz=10.0, lidar_rate_hz=1.0)
    dataset = render_room(tmp_path / "room", options, lambda fraction, text: None)
    estimate = read_tum(run_mapping(algorithm, dataset, tmp_path / "run") / "traj.txt")
    assert len(estimate.stamps_s) == options.frames
    assert dataset.groundtruth_path is not None
    truth = read_tum(dataset.groundtruth_path)
    nearest = np.searchsorted(truth.stamps_s, estimate.stamps_s - 1e-6)
    travelled_m = np.linalg.norm(np.diff(truth.positions_m[nearest], axis=0), axis=1).sum()
    estimated_m = np.linalg.norm(np.diff(estimate.positions_m, axis=0), axis=1).sum()
    # Camera and body paths differ by the lever arm, and single steps are noisy: the length is right within a third.
    assert estimated_m == pytest.approx(travelled_m, rel=0.33)
