"""Imported files whose orientations mean nothing: they count as positions, and the import says so."""

import pytest
from click.testing import CliRunner

from slamhive.cli import main
from slamhive.domain.sensors import SensorSetup
from slamhive.services.imports.request import ImportRequest
from slamhive.services.imports.sources import parse_setup
from tests.cases import case
from tests.services.imports.world import trajectory, write

pytestmark = pytest.mark.integration


def without_orientation(text: str, quat: str) -> str:
    return "".join(f"{' '.join(line.split()[:4])} {quat}\n" for line in text.splitlines())


def imported(hive, source):
    """The report of the command, and the metrics of the run."""
    called = CliRunner().invoke(main, ["runs", "import", str(source), "--sensors", "lidar-inertial"])
    assert called.exit_code == 0, called.stderr
    run_ids = hive.imports.carry_out(ImportRequest(source, sensors={"": parse_setup("lidar-inertial")}), silent).run_ids
    return called.stderr, hive.runs.get(run_ids[0]).metrics


def silent(_done, _total):
    pass


@pytest.mark.parametrize(
    ("quat", "reason"),
    [("0 0 0 0", "all quaternions are 0 0 0 0"), ("0 0 0 1", "the orientation never changes, although the path turns")],
)
@pytest.mark.parametrize("which", ["groundtruth", "estimate"])
def test_orientations_that_are_none_give_no_rotation_errors(hive, tmp_path, quat, reason, which):
    source = tmp_path / "source"
    truth, estimate = trajectory(), trajectory(1)
    write(source / "seq1" / "groundtruth.txt", without_orientation(truth, quat) if which == "groundtruth" else truth)
    write(source / "lio" / "seq1" / "1.txt", without_orientation(estimate, quat) if which == "estimate" else estimate)
    told, metrics = imported(hive, source)
    assert f"Orientation: {reason}, so there are positions only, and no rotation errors." in told
    assert metrics["ate.rmse"] < 0.1
    assert metrics["rpe_point.rmse"] > 0
    assert not {key for key in metrics if key.startswith(("ate_rot", "rpe_rot", "rpe."))}
    assert hive.catalogue.dataset("seq1").groundtruth.positions_only is (which == "groundtruth")


def test_real_positions_of_a_total_station_are_imported(hive, tmp_path):
    source = case("m2dgr_zero_quaternions", tmp_path / "source")
    told, metrics = imported(hive, source)
    assert "all quaternions are 0 0 0 0" in told
    assert metrics["ate.rmse"] < 0.1
    assert "ate_rot.rmse" not in metrics


def test_a_pose_without_orientation_among_others_is_refused(hive, tmp_path):
    lines = trajectory().splitlines()
    lines[3] = f"{' '.join(lines[3].split()[:4])} 0 0 0 0"
    write(tmp_path / "source" / "seq1" / "groundtruth.txt", trajectory())
    write(tmp_path / "source" / "lio" / "seq1" / "1.txt", "\n".join(lines))
    request = ImportRequest(tmp_path / "source", sensors={"": SensorSetup.LIDAR})
    (problem,) = hive.imports.carry_out(request, silent).problems
    assert "line 4: quaternion is all zero; leave out poses without orientation" in problem.text
