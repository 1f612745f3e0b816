"""Checks are silent on sound recordings of the field, and find what is really wrong with some of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from slamhive.base.project import project_root
from slamhive.domain.dataset import Dataset, Finding, GroundTruth, Severity
from slamhive.recordings.checks.evidence import DatasetEvidence
from slamhive.recordings.checks.registry import check_dataset
from slamhive.recordings.checks.truth import ground_truth, read_truth
from slamhive.recordings.importers.registry import IMPORTERS
from slamhive.recordings.importing import ImportOptions, perform

SHARED = project_root().parent / "shared" / "data"

pytestmark = [
    pytest.mark.shared_data,
    pytest.mark.integration,
    pytest.mark.skipif(not SHARED.is_dir(), reason="no recorded data: ../shared/data does not exist"),
]

NOTHING: set[tuple[str, str]] = set()


def silent(_fraction: float, _text: str) -> None:
    """Show nothing."""


def truth_findings(path: Path) -> list[Finding]:
    """What the checks find in a ground truth that covers its recording."""
    dataset = Dataset("d", path.parent, "", 1.0, (), GroundTruth(path.name, gravity_aligned=True), "")
    truth, problem = read_truth(dataset)
    assert truth is not None, problem
    start_ns, end_ns = (int(time_s * 1e9) for time_s in truth.times_s[[0, -1]])
    found: list[Any] = list(ground_truth(DatasetEvidence(dataset, start_ns, end_ns, truth=truth)))
    return [entry for entry in found if isinstance(entry, Finding)]


@pytest.mark.parametrize(
    "path",
    ["euroc_vio_runs/V1_01/groundtruth.txt", "euroc_vio_runs/MH_05/groundtruth.txt",
     "evo_trajectories/freiburg1_xyz-groundtruth.txt", "kitti06_stereo_51/groundtruth_tum.txt"],
)  # fmt: skip
def test_sound_ground_truths_have_no_findings(path: str):
    assert truth_findings(SHARED / path) == []


def test_the_jump_in_the_ground_truth_of_mh_04_is_found():
    (finding,) = truth_findings(SHARED / "euroc_vio_runs/MH_04/groundtruth.txt")
    assert (finding.check, finding.severity) == ("truth-jumps", Severity.WARNING)
    assert finding.at_s == pytest.approx(45.0, abs=0.01)
    assert finding.value == pytest.approx(0.1395, abs=1e-3)


@pytest.mark.parametrize(
    ("importer", "folder", "expected"),
    [
        ("kitti-odometry", "kitti06_stereo_51", NOTHING),
        ("euroc", "euroc_v101_static", {("spans", "cam0"), ("spans", "cam1")}),
        ("7-scenes", "sevenscenes_rgbd_90", NOTHING),
        ("carmen", "radish_aces_2d", {("gaps", "laser0"), ("gaps", "odom0")}),
    ],
)
def test_findings_on_recordings(importer: str, folder: str, expected: set[tuple[str, str]], tmp_path: Path):
    truth = SHARED / folder / "groundtruth_tum.txt"
    options = ImportOptions(groundtruth=truth if importer == "euroc" else None)
    plan = IMPORTERS.get(importer).plan(SHARED / folder, options)
    report = check_dataset(perform(plan, tmp_path / "made", silent), silent)
    assert {(finding.check, finding.about) for finding in report.findings} == expected
    assert report.count(Severity.ERROR) == 0
    (tmp_path / "made" / "made.bag").unlink()
