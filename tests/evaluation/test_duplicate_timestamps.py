"""Duplicate timestamps through a whole evaluation; what is kept counts as evo's own command line counts it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.project import project_root
from slamhive.domain.protocol import Alignment, Association, Duplicates, Protocol
from slamhive.evaluation.job import Artefacts, EvaluationResult, EvaluationTask
from slamhive.evaluation.references import References
from slamhive.evaluation.runner import EvaluationRunner, ProcessStarter
from slamhive.evaluation.work import FILES, run_task

RUNS = project_root().parent / "shared" / "data" / "euroc_vio_runs"
ESTIMATE, TRUTH = RUNS / "vislam_rp" / "V1_02" / "0.txt", RUNS / "V1_02" / "groundtruth.txt"
POSES = 798
DOUBLED = (100, 250, 251, 600)

pytestmark = pytest.mark.quick


def rows(count: int = 200) -> list[str]:
    """A flight that turns now faster, now slower."""
    t = np.arange(count) / 10
    return [
        f"{s:.3f} {np.cos(s):.9f} {np.sin(s / 2):.9f} {np.sin(s):.9f} 0 0 {np.sin(yaw):.9f} {np.cos(yaw):.9f}\n"
        for s, yaw in zip(t.tolist(), (s / 8 + 0.3 * np.sin(s) for s in t), strict=True)
    ]


def doubled(lines: list[str], places: tuple[int, ...]) -> list[str]:
    """Every line at ``places`` gets the timestamp of the line before."""
    found = list(lines)
    for place in places:
        found[place] = " ".join([found[place - 1].split()[0], *lines[place].split()[1:]]) + "\n"
    return found


def evaluated(folder: Path, estimate: str, truth: str, protocol: Protocol, artefacts: Artefacts) -> EvaluationResult:
    for name, text in (("traj.txt", estimate), ("groundtruth.txt", truth)):
        (folder / name).write_text(text)
    output = folder / "out"
    output.mkdir(exist_ok=True)
    task = EvaluationTask("1", folder / "traj.txt", folder / "groundtruth.txt", output, protocol, artefacts=artefacts)
    if artefacts is Artefacts.METRICS:
        return run_task(task, References())
    (folder / "scratch").mkdir()
    return EvaluationRunner(ProcessStarter(project_root())).run([task], folder / "scratch", lambda _result: None)[0]


@pytest.mark.parametrize("association", [entry for entry in Association if entry is not Association.INDEX])
@pytest.mark.parametrize("how", [Duplicates.FIRST, Duplicates.MEAN, Duplicates.KEEP])
@pytest.mark.parametrize("which", ["estimate", "truth", "both"])
def test_every_association_copes(tmp_path: Path, association: Association, how: Duplicates, which: str) -> None:
    lines, other = rows(), doubled(rows(), (1, 50, 51, 199))
    estimate = "".join(lines if which == "truth" else other)
    truth = "".join(lines if which == "estimate" else other)
    search_s = 0.1 if which == "estimate" else 0.0
    protocol = Protocol(Alignment.SE3, association=association, offset_search_s=search_s, duplicates=how)
    result = evaluated(tmp_path, estimate, truth, protocol, Artefacts.METRICS)
    assert result.reason is None
    assert result.metrics["ate.rmse"] < 0.05
    assert "cannot be computed" not in " ".join(result.missing.values())
    refused = evaluated(tmp_path, estimate, truth, Protocol(Alignment.SE3), Artefacts.METRICS)
    assert "occurs twice; write one pose for each timestamp" in (refused.reason or "")


@pytest.mark.integration
def test_plots_are_drawn_of_kept_duplicates(tmp_path: Path) -> None:
    text = "".join(doubled(rows(), (1, 50, 51, 199)))
    protocol = Protocol(Alignment.SE3, duplicates=Duplicates.KEEP)
    result = evaluated(tmp_path, text, text, protocol, Artefacts.PLOTS)
    assert (result.reason, result.matched_poses) == (None, 200)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {*FILES, "traj_speeds.png", "ape_map.png"} <= names


@pytest.mark.integration
@pytest.mark.shared_data
@pytest.mark.skipif(not RUNS.is_dir(), reason="the recorded data is not in ../shared/data")
@pytest.mark.parametrize("which", ["estimate", "truth"])
def test_what_is_kept_counts_as_evo_counts(tmp_path: Path, which: str) -> None:
    """A flight as evo's example V102: 798 poses, four timestamps twice."""
    estimate = [line for line in ESTIMATE.read_text().splitlines(True) if not line.startswith("#")][:POSES]
    truth = [line for line in TRUTH.read_text().splitlines(True) if not line.startswith("#")]
    if which == "estimate":
        estimate = doubled(estimate, DOUBLED)
    else:
        truth = doubled(truth, tuple(20 * place for place in DOUBLED))
    protocol = Protocol(Alignment.SE3, duplicates=Duplicates.KEEP)
    result = evaluated(tmp_path, "".join(estimate), "".join(truth), protocol, Artefacts.METRICS)
    program = str(Path(sys.executable).parent / "evo_ape")
    environment = {"PATH": os.environ["PATH"], "HOME": str(tmp_path), "MPLBACKEND": "Agg"}
    arguments = [program, "tum", str(tmp_path / "groundtruth.txt"), str(tmp_path / "traj.txt"), "-a", "-v"]
    text = subprocess.run(
        arguments, env=environment, cwd=tmp_path, check=True, capture_output=True, text=True, timeout=120
    ).stdout
    pairs = re.search(r"Compared (\d+) absolute pose pairs", text)
    rmse_m = re.search(r"rmse\s+([0-9.]+)", text)
    assert pairs is not None
    assert rmse_m is not None
    assert result.matched_poses == int(pairs[1]) == POSES
    assert result.metrics["ate.rmse"] == pytest.approx(float(rmse_m[1]), abs=5e-7)
