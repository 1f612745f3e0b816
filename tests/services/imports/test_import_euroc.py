"""122 published runs of four systems: imported at once, and the errors are those computed independently."""

import csv
import shutil

import pytest

from slamhive.base.project import project_root
from slamhive.cli.waiting import evaluate_to_end
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.domain.sensors import SensorSetup
from slamhive.evaluation.evaluators.evo_errors import AbsoluteError
from slamhive.evaluation.pairing import pair
from slamhive.evaluation.references import TruthReference
from slamhive.services.imports.request import ImportRequest
from slamhive.trajectory.layout import read_tum

SOURCE = project_root().parent / "shared" / "data" / "euroc_vio_runs"
COLUMNS = {
    Alignment.SE3: "ate_rmse_se3_m",
    Alignment.SIM3: "ate_rmse_sim3_m",
    Alignment.YAW_POSITION: "ate_rmse_posyaw_m",
}
AGREEMENT_M = 5.1e-5
"""The published figures have four decimals."""

pytestmark = [
    pytest.mark.shared_data,
    pytest.mark.integration,
    pytest.mark.skipif(not SOURCE.is_dir(), reason="the recorded runs are not in ../shared/data/euroc_vio_runs"),
]


@pytest.fixture
def expected():
    with (SOURCE / "ate_rmse.csv").open(newline="") as stream:
        return {(row["algorithm"], row["sequence"], row["trial"]): row for row in csv.DictReader(stream)}


def test_all_runs_are_imported_and_their_errors_are_the_published_ones(hive, expected):
    sensors = {"": SensorSetup.STEREO_INERTIAL, "vio_mono": SensorSetup.MONO_INERTIAL}
    report = hive.imports.carry_out(ImportRequest(SOURCE, sensors=sensors, gravity_aligned=True), lambda *_: None)
    assert (report.imported, report.problems, report.left_out) == (122, [], ["ate_rmse.csv"])
    references = {
        name: TruthReference(read_tum(hive.catalogue.dataset(name).groundtruth_path)) for name in report.datasets
    }
    seen = set()
    for run_id in report.run_ids:
        run, trial = hive.runs.get(run_id), hive.runs.record(run_id)["imported"]["trial"]
        default = hive.evaluations.protocol_of(run)
        assert (default.alignment, default.association_tolerance_s) == (Alignment.YAW_POSITION, 0.01)
        estimate = read_tum(hive.runs.folder(run_id).trajectory)
        row = expected[run.algorithm, run.dataset, trial]
        seen.add((run.algorithm, run.dataset, trial))
        assert run.poses == int(row["n_est"])
        for alignment, column in COLUMNS.items():
            paired = pair(references[run.dataset], estimate, Protocol(alignment, association_tolerance_s=0.01))
            assert len(paired.aligned) == int(row["n_matched"])
            found_m = AbsoluteError().evaluate(paired).values["ate.rmse"]
            assert found_m == pytest.approx(float(row[column]), abs=AGREEMENT_M), (run.algorithm, run.dataset, trial)
    assert seen == set(expected)


def test_the_whole_way_gives_the_same_figures(hive, expected, tmp_path):
    """Imported, queued, evaluated in the evaluation's own process, stored: a trial of each system on one sequence."""
    systems = ("vio_mono", "vio_stereo", "vislam_ba", "vislam_rp")
    for name in ("V2_03/groundtruth.txt", *(f"{system}/V2_03/0.txt" for system in systems)):
        (tmp_path / "source" / name).parent.mkdir(parents=True)
        shutil.copyfile(SOURCE / name, tmp_path / "source" / name)
    sensors = {"": SensorSetup.STEREO_INERTIAL}
    report = hive.imports.carry_out(
        ImportRequest(tmp_path / "source", sensors=sensors, gravity_aligned=True), lambda *_: None
    )
    ended = evaluate_to_end(hive.evaluations, hive.evaluations.queue(report.run_ids))
    assert [entry.reason for entry in ended] == [None] * len(systems)
    for run in map(hive.runs.get, report.run_ids):
        row = expected[run.algorithm, "V2_03", "0"]
        assert run.metrics["ate.rmse"] == pytest.approx(float(row["ate_rmse_posyaw_m"]), abs=AGREEMENT_M)
