"""Trajectories become runs: whole, once, marked, evaluated, and found again by their folders."""

import json
import os
import shutil
import threading
from dataclasses import asdict
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamhive.base.errors import Conflict, InvalidInput
from slamhive.base.files import write_aside
from slamhive.cli import main
from slamhive.documents.submission import Submission
from slamhive.domain.configuration import Configuration
from slamhive.domain.protocol import TrajectoryKind
from slamhive.domain.run import RunState
from slamhive.domain.sensors import SensorSetup
from slamhive.evaluation.presets import PRESETS
from slamhive.services.hive import open_hive
from slamhive.services.imports import request, service
from slamhive.services.imports.request import ImportRequest, one_import
from slamhive.services.reindex import reindex
from slamhive.trajectory.kitti import format_kitti
from slamhive.trajectory.layout import parse_tum
from tests.services.imports.world import POSES, make_source, trajectory, write

pytestmark = pytest.mark.integration

STEREO = {"": SensorSetup.STEREO}
EVERY_FILE = 8


@pytest.fixture
def source(tmp_path):
    return make_source(tmp_path / "source")


def carry_out(hive, source, **options):
    options.setdefault("sensors", STEREO)
    dry_run = options.pop("dry_run", False)
    return hive.imports.carry_out(ImportRequest(source, **options), lambda _done, _total: None, dry_run=dry_run)


def everything(root: Path) -> dict[str, bytes | None]:
    found = {path: None if path.is_dir() else path.read_bytes() for path in root.rglob("*")}
    return {str(path.relative_to(root)): content for path, content in found.items() if "slamhive.db" not in path.name}


def test_the_kind_of_trajectory_is_stored_as_told(hive, source):
    report = carry_out(hive, source, trajectory=TrajectoryKind.KEYFRAMES)
    run_id = report.run_ids[0]
    assert (hive.runs.get(run_id).trajectory, hive.runs.record(run_id)["trajectory"]) == ("keyframes", "keyframes")


def test_every_trajectory_becomes_a_run_that_says_where_it_comes_from(hive, source):
    report = carry_out(hive, source)
    assert (report.imported, report.known, report.problems) == (EVERY_FILE, 0, [])
    assert report.datasets == ["seq1", "seq2"]
    first = hive.runs.get(report.run_ids[0])
    assert (first.algorithm, first.dataset, first.executor, first.state) == (
        "alpha",
        "seq1",
        "imported",
        RunState.SUCCEEDED,
    )
    assert (first.poses, first.host, first.version, first.exit_code, first.started_at) == (
        POSES,
        None,
        None,
        None,
        None,
    )
    assert first.detail == f"imported from alpha/seq1/0.txt, trial 0: {POSES} poses"
    assert first.metrics == {}, "nothing was measured, and nothing is made up"
    folder = hive.runs.folder(first.id)
    assert folder.trajectory.read_bytes() == (source / "alpha/seq1/0.txt").read_bytes()
    origin = hive.runs.record(first.id)["imported"]
    assert (origin["source"], origin["trial"], origin["format"]) == ("alpha/seq1/0.txt", "0", "tum")
    assert str(source) not in folder.record.read_text(), "the way to the source is private"


def test_repeats_are_one_configuration(hive, source):
    runs = [hive.runs.get(run_id) for run_id in carry_out(hive, source).run_ids]
    assert len({run.configuration_id for run in runs}) == 4
    assert runs[0].configuration_id == runs[1].configuration_id


def test_the_same_command_again_changes_nothing(hive, source):
    first = carry_out(hive, source)
    before = everything(hive.settings.data)
    second = carry_out(hive, source)
    assert (second.imported, second.known, second.run_ids) == (0, EVERY_FILE, first.run_ids)
    assert everything(hive.settings.data) == before


def test_what_is_new_is_added(hive, source):
    carry_out(hive, source)
    write(source / "gamma" / "seq1" / "0.txt", trajectory(99))
    report = carry_out(hive, source)
    assert (report.imported, report.known) == (1, EVERY_FILE)


def test_another_trajectory_for_a_known_trial_is_refused(hive, source):
    first = carry_out(hive, source)
    write(source / "alpha" / "seq1" / "0.txt", trajectory(99))
    report = carry_out(hive, source)
    (problem,) = report.problems
    assert problem.name == "alpha/seq1/0.txt"
    assert f"was imported as run {first.run_ids[0]} with another trajectory" in problem.text
    assert report.imported == 0


def test_a_dry_run_reads_everything_and_writes_nothing(hive, source):
    write(source / "alpha" / "seq1" / "7.txt", "1 nan 0 0 0 0 0 1\n")
    before = everything(hive.settings.data)
    report = carry_out(hive, source, dry_run=True)
    assert (report.imported, report.datasets, report.run_ids) == (EVERY_FILE, ["seq1", "seq2"], [])
    assert "tx is nan" in report.problems[0].text
    after = everything(hive.settings.data)
    assert after == before
    assert sum(hive.runs.counts().values()) == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        (trajectory(1, poses=1), "holds a single pose"),
        ("1 nan 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", "line 1: tx is nan"),
        ("1 0 0\n", "3 columns"),
        ("\0\0", "not a text file"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "comes after"),
        ("1 0 0 0 0 0 0 0\n2 0 0 0 0 0 0 1\n", "line 1"),
    ],
)
def test_a_file_that_is_no_trajectory_is_told_and_the_others_are_imported(hive, source, text, message):
    write(source / "alpha" / "seq1" / "0.txt", text)
    report = carry_out(hive, source)
    assert report.imported == EVERY_FILE - 1
    (problem,) = report.problems
    assert problem.name == "alpha/seq1/0.txt"
    assert message in problem.text
    assert "\n" not in problem.text


def test_where_every_trajectory_is_refused_no_dataset_is_made(hive, source):
    for path in source.glob("*/seq1/*.txt"):
        path.write_text("nonsense\n")
    before = everything(hive.settings.data)
    assert carry_out(hive, source, dry_run=True).datasets == ["seq2"]
    report = carry_out(hive, source)
    assert (report.imported, report.datasets, len(report.problems)) == (EVERY_FILE // 2, ["seq2"], EVERY_FILE // 2)
    made = everything(hive.settings.data).keys() - before.keys()
    assert [name for name in made if "seq1" in name] == []
    assert "seq1" not in {dataset.name for dataset in hive.catalogue.datasets()}


def test_a_file_that_cannot_be_read_is_told(hive, source):
    (source / "alpha" / "seq1" / "0.txt").unlink()
    os.mkfifo(source / "alpha" / "seq1" / "0.txt")
    assert "is not a regular file" in carry_out(hive, source).problems[0].text


def test_a_damaged_ground_truth_costs_its_dataset_and_is_told_once(hive, source):
    write(source / "seq1" / "groundtruth.txt", "nonsense\n")
    report = carry_out(hive, source)
    assert report.imported == EVERY_FILE // 2
    (problem,) = report.problems
    assert problem.name == "dataset seq1 (4 files)"
    assert not (hive.settings.datasets_folder / "seq1").exists()


def test_a_dataset_without_a_ground_truth_is_told_with_the_remedy(hive, source):
    (source / "seq1" / "groundtruth.txt").unlink()
    report = carry_out(hive, source)
    assert "--groundtruth" in report.problems[0].text
    assert report.imported == EVERY_FILE // 2


def test_a_ground_truth_of_positions_alone_is_taken(hive, source):
    rows = [line.split()[:4] for line in trajectory().splitlines()]
    write(source / "seq1" / "groundtruth.txt", "".join(" ".join(row) + "\n" for row in rows))
    report = carry_out(hive, source)
    assert (report.imported, report.problems) == (EVERY_FILE, [])
    assert hive.catalogue.dataset("seq1").groundtruth.positions_only
    assert not hive.catalogue.dataset("seq2").groundtruth.positions_only
    (run_id,) = [
        run_id for run_id in report.run_ids if hive.runs.get(run_id).detail.startswith("imported from alpha/seq1/0")
    ]
    assert CliRunner().invoke(main, ["evaluate", str(run_id)]).exit_code == 0
    figures = hive.runs.get(run_id).metrics
    assert 0 < figures["ate.rmse"] < 0.1
    assert "ate_rot.rmse" not in figures


def test_a_ground_truth_of_a_single_pose_is_refused(hive, source):
    write(source / "seq1" / "groundtruth.txt", trajectory(0, poses=1))
    (problem,) = carry_out(hive, source).problems
    assert problem.text.endswith("groundtruth.txt holds a single pose; a ground truth needs two at least")
    assert not (hive.settings.datasets_folder / "seq1").exists()


def test_a_dataset_that_is_here_keeps_its_ground_truth(hive, source):
    carry_out(hive, source)
    write(source / "seq1" / "groundtruth.txt", trajectory(5))
    write(source / "gamma" / "seq1" / "0.txt", trajectory(6))
    report = carry_out(hive, source)
    assert "is here with another ground truth" in report.problems[0].text
    without = carry_out(hive, source, ground_truth="")
    assert without.problems == []
    assert without.imported == 1


def test_runs_can_be_imported_onto_a_dataset_with_a_recording(hive, tmp_path):
    write(tmp_path / "source" / "alpha" / "track" / "0.txt", trajectory(1))
    report = carry_out(hive, tmp_path / "source")
    assert report.problems == []
    assert report.datasets == []
    assert hive.runs.get(report.run_ids[0]).dataset == "track"


def test_what_an_algorithm_senses_with_has_to_be_known(hive, source):
    report = carry_out(hive, source, sensors={"alpha": SensorSetup.MONO})
    (problem,) = report.problems
    assert problem.name == "algorithm beta (4 files)"
    assert "--sensors beta=SETUP" in problem.text
    assert report.imported == EVERY_FILE // 2
    again = carry_out(hive, source, sensors=STEREO)
    assert "senses with mono here, not with stereo" in again.problems[0].text
    with pytest.raises(InvalidInput, match="--sensors names 'gamma'"):
        carry_out(hive, source, sensors={"gamma": SensorSetup.MONO, **STEREO})


def test_alignment_follows_the_sensors(hive, source):
    runs = carry_out(hive, source, sensors={"alpha": SensorSetup.MONO, **STEREO}).run_ids
    labels = {
        hive.runs.get(run_id).algorithm: hive.evaluations.protocol_of(hive.runs.get(run_id)).alignment.value
        for run_id in runs
    }
    assert labels == {"alpha": "sim3", "beta": "se3"}


def test_runs_are_found_by_mark_and_sensors(hive, source):
    runs = carry_out(hive, source, sensors={"alpha": SensorSetup.MONO, **STEREO}).run_ids
    assert hive.searches.find("executor = imported") == runs
    assert {hive.runs.get(run_id).algorithm for run_id in hive.searches.find("sensor = mono")} == {"alpha"}


def test_a_folder_in_which_nothing_matches_is_refused_with_an_example(hive, source):
    with pytest.raises(InvalidInput, match=r"matches the pattern '<algorithm>/<dataset>\.tum'; the first of"):
        carry_out(hive, source, pattern="<algorithm>/<dataset>.tum")


def test_kitti_and_euroc_files_are_read(hive, tmp_path):
    source = make_source(tmp_path / "source", ("alpha",), trials=1)
    poses = parse_tum(trajectory(3).encode(), "t")
    stamps = "".join(f"{stamp:.6f}\n" for stamp in poses.stamps_s)
    write(source / "seq1" / "times.txt", stamps)
    write(source / "kitti" / "seq1" / "0.txt", format_kitti(poses.positions_m, poses.quats_xyzw))
    rows = "".join(
        f"{round(stamp * 1e9)},{x},{y},{z},{w},{i},{j},{k},0,0,0\n"
        for stamp, (x, y, z), (i, j, k, w) in zip(poses.stamps_s, poses.positions_m, poses.quats_xyzw, strict=True)
    )
    write(source / "euroc" / "seq1" / "0.txt", "#timestamp, p_x\n" + rows)
    write(source / "kitti" / "seq2" / "0.txt", format_kitti(poses.positions_m, poses.quats_xyzw))
    report = carry_out(hive, source)
    assert [problem.name for problem in report.problems] == ["kitti/seq2/0.txt"]
    assert "KITTI poses, which have no timestamps" in report.problems[0].text
    found = {hive.runs.record(run_id)["imported"]["format"]: run_id for run_id in report.run_ids}
    assert set(found) == {"tum", "kitti", "euroc"}
    for kind in ("kitti", "euroc"):
        read = parse_tum(hive.runs.folder(found[kind]).trajectory.read_bytes(), kind)
        assert abs(read.positions_m - poses.positions_m).max() < 1e-6
        assert abs(read.stamps_s - poses.stamps_s).max() < 1e-6


def test_nothing_can_be_run_on_a_dataset_without_recording_nor_tried_again(hive, source):
    run_id = carry_out(hive, source).run_ids[0]
    with pytest.raises(InvalidInput, match="seq1 is a ground truth without a recording"):
        hive.runs.submit(Submission(algorithm="tiny", dataset="seq1"))
    with pytest.raises(Conflict, match=f"run {run_id} was imported"):
        hive.runs.retry(run_id)


def test_reindex_restores_imported_runs(hive, source):
    report = carry_out(hive, source)
    before = [hive.runs.get(run_id) for run_id in report.run_ids]
    hive.close()
    for path in hive.settings.data.glob("*.db*"):
        path.unlink()
    again = open_hive()
    try:
        restored = reindex(again, lambda _done, _total: None)
        assert (restored.runs, restored.skipped) == (EVERY_FILE, [])
        for run_id, run in zip(report.run_ids, before, strict=True):
            assert asdict(again.runs.get(run_id)) == asdict(run)
        assert carry_out(again, source).known == EVERY_FILE
        assert [again.evaluations.protocol_of(run).alignment.value for run in before] == ["se3"] * EVERY_FILE
    finally:
        again.close()


def test_who_waits_for_another_import_is_told_for_which_and_since_when(hive, source, monkeypatch):
    monkeypatch.setattr(request, "WAIT_S", 0.2)
    said: list[str] = []
    with one_import(hive.settings.runs_folder, "an archive of 30,000 runs"):
        with pytest.raises(Conflict, match=r"another import files an archive of 30,000 runs since \d\d:\d\d:\d\d UTC"):
            carry_out(hive, source)
        with pytest.raises(Conflict), one_import(hive.settings.runs_folder, "1 trajectory", said.append):
            pass
        carry_out(hive, source, dry_run=True)
    assert said
    assert all(text.startswith("waiting: another import files an archive of 30,000 runs since") for text in said)


def test_a_small_import_gets_its_turn_between_the_batches_of_a_large_one(hive, source, tmp_path, monkeypatch):
    monkeypatch.setattr(service, "BATCH", 1)
    small, reports = tmp_path / "small", []
    shutil.copytree(source, small)
    threads = []

    def meanwhile(done, _total):
        if done == 1:
            threads.append(threading.Thread(target=lambda: reports.append(carry_out(hive, small))))
            threads[0].start()
            threads[0].join(20)

    report = hive.imports.carry_out(ImportRequest(source, sensors=STEREO), meanwhile)
    assert not threads[0].is_alive()
    (other,) = reports
    assert other.imported > 0
    assert report.imported == 1
    assert report.imported + other.imported == len(hive.runs.page(limit=1000).records)


def test_a_full_disk_leaves_no_half_run(hive, source, monkeypatch):
    written = []

    def full(path, content):
        written.append(path)
        if len(written) == 3:
            raise OSError(28, "No space left on device")
        write_aside(path, content)

    monkeypatch.setattr("slamhive.run_folder.folder.write_aside", full)
    with pytest.raises(Exception, match="No space left"):
        carry_out(hive, source)
    monkeypatch.undo()
    report = carry_out(hive, source)
    assert (report.imported + report.known, len(report.run_ids)) == (EVERY_FILE, EVERY_FILE)
    assert sorted(path.name for path in hive.settings.runs_folder.glob("[0-9]*")) == sorted(map(str, report.run_ids))
    assert not list(hive.settings.runs_folder.glob(".import-*"))


def test_configurations_of_imports_are_listed_as_others(hive, source):
    run = hive.runs.get(carry_out(hive, source).run_ids[0])
    assert hive.configurations.get(run.configuration_id).configuration == Configuration("alpha", "seq1", {})


def test_the_command_imports_and_evaluates(hive, source):
    write(source / "alpha" / "seq1" / "5.txt", "nonsense\n")
    called = CliRunner().invoke(main, ["runs", "import", str(source), "--sensors", "stereo", "--json"])
    shown = json.loads(called.stdout)
    assert called.exit_code == 1
    assert (shown["imported"], shown["evaluated"], shown["failed_evaluations"]) == (EVERY_FILE, EVERY_FILE, {})
    assert [problem["name"] for problem in shown["problems"]] == ["alpha/seq1/5.txt"]
    (source / "alpha" / "seq1" / "5.txt").unlink()
    again = CliRunner().invoke(main, ["runs", "import", str(source), "--sensors", "stereo"])
    assert again.exit_code == 0
    assert again.stdout == f"0 runs imported, {EVERY_FILE} known already, 0 evaluated\n"
    listed = json.loads(CliRunner().invoke(main, ["runs", "--json"]).stdout)
    assert all(0 < entry["metrics"]["ate.rmse"]["value"] < 0.1 for entry in listed)
    assert {entry["executor"] for entry in listed} == {"imported"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sensors", "sterio"], "did you mean 'stereo'?"),
        (["--sensors", "mono", "--sensors", "stereo"], "is given twice"),
        (["--pattern", "<algo>/x", "--sensors", "mono"], "unknown field <algo>"),
    ],
)
def test_the_command_explains_options_in_one_line(hive, source, arguments, message):
    called = CliRunner().invoke(main, ["runs", "import", str(source), *arguments])
    assert called.exit_code == 1
    assert message in called.stderr
    assert called.stderr.strip().count("\n") == 0


def test_times_of_images_are_stored_and_every_evaluation_of_eth3d_uses_them(hive, tmp_path):
    truth = "".join(f"{100 + i / 100:.6f} {i / 100:.6f} {(i / 100) ** 2:.6f} 0 0 0 0 1\n" for i in range(300))
    write(tmp_path / "source" / "desk" / "groundtruth.txt", truth)
    write(tmp_path / "source" / "desk" / "rgb.txt", "".join(f"{100.1 + i / 8:.6f} rgb/{i}.png\n" for i in range(22)))
    estimate = "".join(f"{100 + i / 4:.6f} {i / 4:.6f} {(i / 4) ** 2:.6f} 0 0 0 0 1\n" for i in range(12))
    write(tmp_path / "source" / "orb" / "desk" / "1.txt", estimate)
    report = carry_out(hive, tmp_path / "source")
    assert (report.imported, report.problems, report.left_out) == (1, [], [])
    stored = hive.catalogue.dataset("desk").groundtruth
    assert stored.files == ("groundtruth.txt", "image_times.txt")
    compared = hive.runs.folder(report.run_ids[0]).evaluation(PRESETS.get("eth3d").protocol.fingerprint) / "traj.tum"
    for _ in range(2):
        assert CliRunner().invoke(main, ["evaluate", str(report.run_ids[0]), "--protocol", "eth3d"]).exit_code == 0
        assert len(parse_tum(compared.read_bytes(), "traj.tum")) == 22
    again = carry_out(hive, tmp_path / "source")
    assert (again.known, again.problems) == (1, [])
    write(tmp_path / "source" / "desk" / "rgb.txt", "100.5 rgb/0.png\n101 rgb/1.png\n")
    (problem,) = carry_out(hive, tmp_path / "source").problems
    assert "desk is here with other image times than those to import" in problem.text
    assert carry_out(hive, tmp_path / "source", image_times="").known == 1
