"""A dataset that has relations between poses and no ground-truth trajectory, from the import to the stored figures."""

import bz2
import json
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from slamhive.base.errors import InvalidInput
from slamhive.cli import main
from slamhive.documents.submission import Submission
from slamhive.domain.sensors import SensorSetup
from slamhive.services.imports.request import ImportRequest
from tests.cases import case
from tests.services.imports.world import trajectory, write

pytestmark = pytest.mark.integration

ACES = Path(__file__).resolve().parents[4] / "shared" / "data" / "radish_aces_2d"
LASER = {"": SensorSetup.LIDAR}
RELATIONS = "100 101 0.1 0 0 0 0 0\n101 102.5 0.2 0.1 0 0 0 0\n"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    write(tmp_path / "source" / "building" / "relations.txt", RELATIONS)
    write(tmp_path / "source" / "alpha" / "building" / "0.txt", trajectory(1))
    return tmp_path / "source"


def turned(vector_m, yaw_rad):
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ vector_m


def carry_out(hive, source, **options):
    return hive.imports.carry_out(ImportRequest(source, sensors=LASER, **options), lambda _done, _total: None)


def command(*arguments: object) -> tuple[int, str, str]:
    called = CliRunner().invoke(main, [str(argument) for argument in arguments])
    return called.exit_code, called.stdout, called.stderr


def test_relations_alone_become_a_dataset(hive, source):
    report = carry_out(hive, source)
    assert (report.imported, report.datasets, report.problems, report.left_out) == (1, ["building"], [], [])
    dataset = hive.catalogue.dataset("building")
    assert (dataset.groundtruth, dataset.relations, dataset.duration_s) == (None, "relations.txt", 2.5)
    assert (dataset.folder / "relations.txt").read_text() == RELATIONS
    with pytest.raises(InvalidInput, match="building is relations without a recording"):
        hive.runs.submit(Submission(algorithm="tiny", dataset="building"))
    again = carry_out(hive, source)
    assert (again.known, again.datasets, again.problems) == (1, [], [])


def test_the_command_imports_evaluates_and_says_what_is_missing(hive, source):
    code, shown, _ = command("runs", "import", source, "--sensors", "lidar")
    assert (code, shown) == (0, "1 run imported, 0 known already, 1 dataset made of ground truth, 1 evaluated\n")
    (run,) = json.loads(command("runs", "--json", "--where", "relations.matched_fraction = 1")[1])
    figures = {key: entry["value"] for key, entry in run["metrics"].items() if not key.startswith("poses")}
    assert set(figures) == {
        *(
            f"relations.{part}.{name}"
            for part in ("translation", "rotation")
            for name in ("rmse", "mean", "std", "max")
        ),
        "relations.translation.per_motion",
        "relations.matched_fraction",
    }
    assert "ate.rmse" not in run["metrics"], "what is not known is absent"
    rows = np.loadtxt(hive.runs.folder(run["id"]).trajectory)
    at = {round(row[0], 6): row[1:4] for row in rows}
    yaws_rad = {round(row[0], 6): 2 * np.arctan2(row[6], row[7]) for row in rows}
    errors_m = [
        np.linalg.norm(turned(at[second] - at[first], -yaws_rad[first]) - given)
        for first, second, given in ((100, 101, [0.1, 0, 0]), (101, 102.5, [0.2, 0.1, 0]))
    ]
    assert figures["relations.translation.mean"] == pytest.approx(np.mean(errors_m), rel=1e-6)
    assert figures["relations.translation.rmse"] == pytest.approx(math.sqrt(np.mean(np.square(errors_m))), rel=1e-6)


def test_a_dataset_without_recording_can_be_looked_at(hive, source):
    write(source / "seq1" / "groundtruth.txt", trajectory())
    write(source / "alpha" / "seq1" / "0.txt", trajectory(1))
    carry_out(hive, source)
    code, shown, _ = command("dataset", "show", "building")
    assert (code, shown.splitlines()[0]) == (0, "building: 2.5 s, no recording")
    assert "ground truth: no trajectory\nrelations: relations.txt\n" in shown
    assert "ground truth: groundtruth.txt" in command("dataset", "show", "seq1")[1]
    listed = command("dataset", "list")[1].splitlines()
    assert [line.split()[-1] for line in listed if {"building", "seq1"} & set(line.split())] == ["relations", "yes"]


def test_what_a_protocol_cannot_do_without_a_trajectory_is_told_and_the_older_figures_stay(hive, source):
    command("runs", "import", source, "--sensors", "lidar")
    (run,) = json.loads(command("runs", "--json")[1])
    for align, message in (("sim3", "leaves the scale of the estimate open"), ("yaw_position", "building has none")):
        code, _, told = command("evaluate", run["id"], "--align", align)
        assert code == 1
        assert message in told
        assert "Traceback" not in told
    assert json.loads(command("runs", "--json")[1])[0]["metrics"] == run["metrics"]


def test_relations_beside_a_ground_truth(hive, source):
    write(source / "building" / "groundtruth.txt", trajectory())
    report = carry_out(hive, source)
    dataset = hive.catalogue.dataset("building")
    assert dataset.groundtruth is not None
    assert dataset.relations == "relations.txt"
    service = hive.evaluations
    assert [record.id for record in service.waiting()] == []
    code, _, _ = command("evaluate", *report.run_ids)
    assert code == 0
    assert {"ate.rmse", "relations.translation.mean"} <= hive.runs.get(report.run_ids[0]).metrics.keys()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("1 2 3\n", "line 1: 3 columns instead of 8"),
        ("1 2 0 0 0 0 0 inf\n", "line 1: a number is not finite"),
    ],
)
def test_damaged_relations_are_told_and_nothing_is_made(hive, source, text, message):
    write(source / "building" / "relations.txt", text)
    report = carry_out(hive, source)
    (problem,) = report.problems
    assert problem.name == "dataset building (1 file)"
    assert message in problem.text
    assert not (hive.settings.datasets_folder / "building").exists()


def test_other_relations_than_those_that_are_here_are_refused(hive, source):
    carry_out(hive, source)
    write(source / "building" / "relations.txt", "100 101 5 0 0 0 0 0\n")
    write(source / "beta" / "building" / "0.txt", trajectory(2))
    (problem,) = carry_out(hive, source).problems
    assert "building is here with other relations than those to import" in problem.text
    assert carry_out(hive, source, relations="").imported == 1
    write(source / "building" / "groundtruth.txt", trajectory())
    (problem,) = carry_out(hive, source, relations="").problems
    assert "building is here without ground truth, unlike the one to import" in problem.text


def test_a_table_names_relations(hive, tmp_path):
    write(tmp_path / "a.txt", trajectory(1))
    write(tmp_path / "measured.relations", RELATIONS)
    table = write(tmp_path / "table.csv", "algorithm,dataset,file,relations\nalpha,building,a.txt,measured.relations\n")
    report = carry_out(hive, table, table=True)
    assert (report.imported, report.problems) == (1, [])
    assert hive.catalogue.dataset("building").relations == "relations.txt"


def test_relations_show_the_unit_and_judge_a_random_walk(hive, tmp_path):
    """Poses 0.86 apart could be s, ms or us; the relations have exactly these times."""
    times_s = 1000 + 0.86 * np.arange(40)
    steps_m = np.random.default_rng(4).normal(0, 5, (40, 2)).cumsum(axis=0)
    for name, places in (("walk", steps_m), ("exact", np.column_stack((0.4 * np.arange(40), np.zeros(40))))):
        yaws_rad = np.arange(40) if name == "walk" else np.zeros(40)
        poses = zip(times_s, places.tolist(), yaws_rad / 2, strict=True)
        rows = [f"{time_s:.6f} {x} {y} 0 0 0 {np.sin(half)} {np.cos(half)}" for time_s, (x, y), half in poses]
        write(tmp_path / "source" / name / "hall" / "1.txt", "\n".join(rows))
    relations = [f"{times_s[i]:.6f} {times_s[i + 1]:.6f} 0.4 0 0 0 0 0" for i in range(39)]
    write(tmp_path / "source" / "hall" / "relations.txt", "\n".join(relations))
    code, _, told = command("runs", "import", tmp_path / "source", "--sensors", "lidar")
    assert code == 0, told
    verdicts = {run["algorithm"]: run["verdict"]["kind"] for run in json.loads(command("runs", "--json")[1])}
    assert verdicts == {"walk": "diverged_far", "exact": "good"}


def test_a_random_walk_on_real_relations_is_not_good(hive):
    source = case("relations_verdict")
    report = carry_out(hive, source, relations="fr079r/relations.txt", pattern="<algorithm>/<dataset>/<trial>.txt")
    assert (report.imported, report.problems) == (1, [])
    command("evaluate", *report.run_ids)
    (run,) = json.loads(command("runs", "--json")[1])
    assert run["verdict"]["kind"] == "diverged_far"
    assert run["metrics"]["relations.translation.per_motion"]["value"] > 1000


@pytest.mark.shared_data
@pytest.mark.skipif(not ACES.is_dir(), reason="the recorded building is not in ../shared/data")
def test_the_odometry_of_a_recorded_building(hive, tmp_path):
    """Every figure once more by hand, in the plane, at the stamps of the relations."""
    lines = bz2.decompress((ACES / "aces.clf.bz2").read_bytes()).decode().splitlines()
    words = [line.split() for line in lines if line.startswith("FLASER ")]
    poses = {row[-3]: tuple(map(float, row[-6:-3])) for row in words}
    rows = [
        f"{stamp} {x} {y} 0 0 0 {math.sin(h / 2):.12f} {math.cos(h / 2):.12f}" for stamp, (x, y, h) in poses.items()
    ]
    write(tmp_path / "source" / "odometry" / "aces" / "0.txt", "\n".join(rows))
    relations = (ACES / "aces.relations").read_text()
    write(tmp_path / "source" / "aces" / "relations.txt", relations)
    assert command("runs", "import", tmp_path / "source", "--sensors", "lidar")[0] == 0
    errors = []
    for line in relations.splitlines():
        first, second, *numbers = line.split()
        x, y, _, _, _, yaw = map(float, numbers)
        (x1, y1, h1), (x2, y2, h2) = poses[first], poses[second]
        ahead = math.cos(h1) * (x2 - x1) + math.sin(h1) * (y2 - y1)
        left = -math.sin(h1) * (x2 - x1) + math.cos(h1) * (y2 - y1)
        turn = abs(math.remainder(h2 - h1 - yaw, math.tau))
        errors.append((math.hypot(ahead - x, left - y), math.degrees(turn)))
    assert len(errors) == 1279
    (run_id,) = hive.searches.find("dataset = aces")
    figures = hive.runs.get(run_id).metrics
    assert figures["relations.matched_fraction"] == 1
    for part, found in zip(("translation", "rotation"), np.transpose(errors), strict=True):
        assert figures[f"relations.{part}.mean"] == pytest.approx(found.mean(), rel=1e-7)
        assert figures[f"relations.{part}.std"] == pytest.approx(found.std(), rel=1e-7)
        assert figures[f"relations.{part}.max"] == pytest.approx(found.max(), rel=1e-7)
