"""Real trajectories in other units and orders: understood by evidence, or refused with a question; never guessed."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from slamhive.base.project import project_root
from slamhive.cli import main
from slamhive.domain.sensors import SensorSetup
from slamhive.services.imports.request import ImportRequest
from slamhive.trajectory.layout import Convention, QuaternionOrder, TimeUnit
from tests.services.imports.world import trajectory, write

DATA = project_root().parent / "shared" / "data" / "euroc_vio_runs"
SEQUENCE = "V2_03"
ESTIMATE, TRUTH = DATA / "vislam_rp" / SEQUENCE / "0.txt", DATA / SEQUENCE / "groundtruth.txt"
STEREO = {"": SensorSetup.STEREO}

pytestmark = [
    pytest.mark.integration,
    pytest.mark.shared_data,
    pytest.mark.skipif(not DATA.is_dir(), reason="the recorded runs are not in ../shared/data/euroc_vio_runs"),
]


def rewritten(path: Path, unit: str = "s", order: str = "xyzw", header: str = "", step: int = 1) -> str:
    """The file at ``path`` as another program would write it; times are exact, as they are integers here."""
    rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")][::step]
    digits = {"s": 0, "ms": 3, "us": 6, "ns": 9}[unit]
    lines = [header] if header else []
    for stamp, *numbers in rows:
        nanoseconds = int(stamp.partition(".")[0]) * 10**9 + int(stamp.partition(".")[2].ljust(9, "0")[:9])
        time = nanoseconds / 10 ** (9 - digits)
        quat = numbers[3:] if order == "xyzw" else [numbers[6], *numbers[3:6]]
        lines.append(" ".join([f"{time:.6f}" if unit != "ns" else str(nanoseconds), *numbers[:3], *quat]))
    return "\n".join(lines) + "\n"


def source_of(folder: Path, estimate: str, truth: str) -> Path:
    write(folder / "source" / SEQUENCE / "groundtruth.txt", truth)
    write(folder / "source" / "orb" / SEQUENCE / "0.txt", estimate)
    return folder / "source"


def carry_out(hive, source, **options):
    return hive.imports.carry_out(ImportRequest(source, sensors=STEREO, **options), lambda _done, _total: None)


@pytest.fixture(scope="module")
def plain_truth():
    return rewritten(TRUTH, step=4)


@pytest.fixture(scope="module")
def expected_rows():
    return np.loadtxt(ESTIMATE)


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_every_unit_and_order_is_understood(hive, tmp_path, plain_truth, expected_rows, unit, order):
    """Among them what ORB-SLAM3 writes for EuRoC: nanoseconds, x y z w."""
    source = source_of(tmp_path, rewritten(ESTIMATE, unit, order), plain_truth)
    report = carry_out(hive, source)
    assert (report.imported, report.problems) == (1, [])
    folder = hive.runs.folder(report.run_ids[0])
    np.testing.assert_allclose(np.loadtxt(folder.trajectory), expected_rows, atol=1.1e-6)
    origin = hive.runs.record(report.run_ids[0])["imported"]
    assert (origin["time_unit"], origin["quaternion_order"], origin["format"]) == (unit, order, "tum")
    assert f"as {unit} do the timestamps fall into the time of the ground truth" in origin["because"]["time_unit"]
    assert f"deg read as {order}, and to " in origin["because"]["quaternion_order"]


def test_a_tum_file_is_taken_byte_for_byte_and_said_to_be_one(hive, tmp_path, plain_truth):
    source = source_of(tmp_path, ESTIMATE.read_text(), plain_truth)
    report = carry_out(hive, source)
    assert hive.runs.folder(report.run_ids[0]).trajectory.read_bytes() == ESTIMATE.read_bytes()
    (truth, estimate) = report.readings
    assert (truth.as_it_stands, estimate.as_it_stands) == (True, True)
    assert (estimate.time_unit, estimate.quaternion_order) == ("s", "xyzw")
    assert estimate.because["quaternion_order"] == "by its header"


def test_an_order_that_contradicts_the_ground_truth_is_asked_for(hive, tmp_path, plain_truth, expected_rows):
    source = source_of(tmp_path, rewritten(ESTIMATE, "s", "wxyz"), plain_truth)
    (problem,) = carry_out(hive, source).problems
    assert problem.name == f"orb/{SEQUENCE}/0.txt"
    assert problem.text.startswith("the quaternion order is in doubt: xyzw as in TUM files, but the orientations")
    assert problem.text.endswith("say which it is with --quaternion-order (xyzw, wxyz)")
    told = carry_out(hive, source, told=Convention(quaternion_order=QuaternionOrder.WXYZ))
    assert told.imported == 1
    np.testing.assert_allclose(np.loadtxt(hive.runs.folder(told.run_ids[0]).trajectory), expected_rows, atol=1.1e-6)
    assert hive.runs.record(told.run_ids[0])["imported"]["because"]["quaternion_order"] == "as specified"


def test_a_named_format_does_not_overrule_the_ground_truth(hive, tmp_path, plain_truth):
    """``--format euroc`` says w x y z, and ORB-SLAM3's writer of that name writes x y z w."""
    source = source_of(tmp_path, rewritten(ESTIMATE, "ns", "xyzw"), plain_truth)
    called = CliRunner().invoke(main, ["runs", "import", str(source), "--sensors", "stereo", "--format", "euroc"])
    assert called.exit_code == 1
    assert "the quaternion order is in doubt: wxyz by --format euroc, but the orientations" in called.stderr


def test_a_ground_truth_with_its_own_header_is_understood(hive, tmp_path):
    header = "#timestamp [ns],p_x,p_y,p_z,q_w [],q_x [],q_y [],q_z []"
    source = source_of(tmp_path, ESTIMATE.read_text(), rewritten(TRUTH, "ns", "wxyz", header, step=4))
    report = carry_out(hive, source)
    assert report.problems == []
    assert "The ground truth was read with timestamps in ns, quaternions wxyz." in (
        hive.catalogue.dataset(SEQUENCE).description
    )
    again = carry_out(hive, source)
    assert (again.known, again.problems) == (1, [])


def test_a_ground_truth_without_a_header_is_understood_by_its_estimates(hive, tmp_path, plain_truth):
    source = source_of(tmp_path, ESTIMATE.read_text(), rewritten(TRUTH, "us", "wxyz", step=4))
    report = carry_out(hive, source)
    assert report.problems == []
    found = np.loadtxt(hive.catalogue.dataset(SEQUENCE).groundtruth_path)
    expected = np.loadtxt(plain_truth.splitlines())
    np.testing.assert_allclose(found[:, :4], expected[:, :4], atol=2e-6)
    np.testing.assert_allclose(found[:, 4:], expected[:, 4:], atol=1e-4)  # written as unit quaternions


def test_a_ground_truth_in_doubt_costs_its_dataset_and_names_its_own_option(hive, tmp_path):
    rows = [line.split() for line in trajectory(poses=30).splitlines()]
    five_apart = "".join(" ".join([str(5 * i), *row[1:]]) + "\n" for i, row in enumerate(rows))
    write(tmp_path / "source" / "seq" / "groundtruth.txt", five_apart)
    write(tmp_path / "source" / "orb" / "seq" / "0.txt", five_apart)
    (problem,) = carry_out(hive, tmp_path / "source").problems
    assert problem.name == "dataset seq (1 file)"
    assert problem.text == (
        "ground truth groundtruth.txt: the time unit is in doubt: the timestamps are 5 apart, which is 5 s if they "
        "are s, 5 ms if they are ms; say which it is with --groundtruth-time-unit (s, ms, us, ns)"
    )
    assert not (hive.settings.datasets_folder / "seq").exists()
    told = carry_out(hive, tmp_path / "source", truth_told=Convention(TimeUnit.MS))
    assert told.imported == 1
    assert {reading.time_unit for reading in told.readings} == {TimeUnit.MS}


def test_positions_alone_come_in_any_unit(hive, tmp_path):
    rows = [line.split()[:4] for line in rewritten(TRUTH, "ns", step=4).splitlines()]
    source = source_of(tmp_path, ESTIMATE.read_text(), "".join(" ".join(row) + "\n" for row in rows))
    report = carry_out(hive, source)
    assert report.problems == []
    truth = hive.catalogue.dataset(SEQUENCE)
    assert truth.groundtruth.positions_only
    assert truth.duration_s == pytest.approx(114.8, abs=0.5)


def test_a_table_states_unit_and_order_for_each_file(hive, tmp_path, plain_truth):
    write(tmp_path / "gt.txt", plain_truth)
    write(tmp_path / "a.txt", rewritten(ESTIMATE, "s", "wxyz"))
    write(tmp_path / "b.txt", rewritten(ESTIMATE, "ns", "xyzw"))
    header = "algorithm,dataset,trial,file,groundtruth,sensors,time_unit,quaternion_order,groundtruth_time_unit\n"
    rows = "orb,x,1,a.txt,gt.txt,stereo,s,wxyz,s\norb,x,2,b.txt,gt.txt,stereo,,,s\n"
    report = carry_out(hive, write(tmp_path / "runs.csv", header + rows), table=True)
    assert (report.imported, report.problems) == (2, [])
    orders = [(reading.time_unit, reading.quaternion_order) for reading in report.readings]
    assert orders == [("s", "xyzw"), ("s", "wxyz"), ("ns", "xyzw")]
    bad = write(tmp_path / "bad.csv", header + "orb,x,3,a.txt,gt.txt,stereo,min,wxyz,s\n")
    assert "unknown time_unit 'min'" in carry_out(hive, bad, table=True).problems[0].text


def test_the_command_says_how_files_were_read_and_why(hive, tmp_path, plain_truth):
    source = source_of(tmp_path, rewritten(ESTIMATE, "ns"), plain_truth)
    called = CliRunner().invoke(main, ["runs", "import", str(source), "--sensors", "stereo"])
    assert called.exit_code == 0
    line = next(line for line in called.stderr.splitlines() if "read with timestamps" in line)
    assert line.startswith(
        f"orb/{SEQUENCE}/0.txt was read with timestamps in ns, quaternions xyzw. Unit: only as ns do the timestamps "
        "fall into the time of the ground truth. Order: the orientations agree with the ground truth to"
    )
    again = CliRunner().invoke(main, ["runs", "import", str(source), "--sensors", "stereo", "--json"])
    readings = {entry["name"]: entry for entry in json.loads(again.stdout)["readings"]}
    assert readings[f"orb/{SEQUENCE}/0.txt"]["time_unit"] == "ns"
    assert readings[f"the ground truth of {SEQUENCE}"]["quaternion_order"] == "xyzw"
    assert hive.runs.get(1).metrics["ate_rot.rmse"] < 10, "144 deg with the quaternions in the other order"


def test_duplicate_timestamps_are_refused_or_repaired_as_told(hive, tmp_path, plain_truth):
    lines = plain_truth.splitlines(True)
    lines[100] = " ".join([lines[99].split()[0], *lines[100].split()[1:]]) + "\n"
    source = source_of(tmp_path, ESTIMATE.read_text(), "".join(lines))
    (problem,) = carry_out(hive, source).problems
    assert "occurs twice" in problem.text
    assert "--duplicates first, mean or keep" in problem.text
    arguments = ["runs", "import", str(source), "--sensors", "stereo", "--duplicates", "mean"]
    assert CliRunner().invoke(main, arguments).exit_code == 0
    run = hive.runs.get(1)
    assert run.protocol.label.endswith("duplicate timestamps: their mean counts")
    assert run.metrics["ate.rmse"] < 0.5
    assert (hive.catalogue.dataset(SEQUENCE).groundtruth_path).read_text() == "".join(lines), "the file stays as it is"
    other = CliRunner().invoke(main, ["evaluate", "1", "--align", "sim3"])
    assert other.exit_code == 1
    assert "--duplicates first, mean or keep" in other.stderr
    kept = CliRunner().invoke(main, ["evaluate", "1", "--align", "sim3", "--duplicates", "keep"])
    assert kept.exit_code == 0
