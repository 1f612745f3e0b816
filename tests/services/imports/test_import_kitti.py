"""Published KITTI results through the product: the figures of each tool, to the digits that they are published with."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamhive.cli import main
from slamhive.domain.sensors import SensorSetup
from slamhive.services.imports.request import ImportRequest

DATA = Path(__file__).resolve().parents[4] / "shared" / "data" / "evo_trajectories"

pytestmark = [
    pytest.mark.shared_data,
    pytest.mark.integration,
    pytest.mark.skipif(not DATA.is_dir(), reason="the recorded data is not in ../shared/data"),
]


def test_orb_slam_on_kitti_00_counts_as_the_devkit_and_evo_count(hive, tmp_path):
    source = tmp_path / "source"
    for name, place in (("ORB", "orb/00/0.txt"), ("gt", "00/groundtruth.txt"), ("gt_times", "00/times.txt")):
        (source / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(DATA / f"KITTI_00_{name}.txt", source / place)
    request = ImportRequest(source, sensors={"": SensorSetup.STEREO})
    report = hive.imports.carry_out(request, lambda _done, _total: None)
    assert (report.imported, report.problems) == (1, [])
    (run_id,) = report.run_ids
    assert hive.runs.folder(run_id).kitti_poses.read_bytes() == (source / "orb/00/0.txt").read_bytes()
    for protocol in ("evo", "kitti"):
        assert CliRunner().invoke(main, ["evaluate", str(run_id), "--protocol", protocol, "--current"]).exit_code == 0
        if protocol == "evo":
            assert round(hive.runs.get(run_id).metrics["ate.rmse"], 6) == 1.303450
    figures = hive.runs.get(run_id).metrics
    assert round(figures["kitti.translation"], 6) == 0.699734
    assert round(figures["kitti.rotation"], 8) == 0.00253352
    assert figures["kitti.segments"] == 3283
    percents = [round(figures[f"kitti.translation.{length}m"], 4) for length in range(100, 900, 100)]
    assert percents == [1.0091, 0.8744, 0.7809, 0.7189, 0.6553, 0.5720, 0.4926, 0.4159]
    again = hive.imports.carry_out(request, lambda _done, _total: None)
    assert (again.known, again.problems) == (1, [])
