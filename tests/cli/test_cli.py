"""The command line on a small project: what it prints, and its one line for each mistake."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from slamhive.cli.main import main as root
from slamhive.cli.output import columns_to_leave_out, print_table
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.quick


@pytest.fixture
def slamhive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sqlite_template: Path):
    make_project(tmp_path / "project")
    make_dataset(tmp_path / "data")
    shutil.copy(sqlite_template, tmp_path / "data" / "slamhive.db")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)

    def call(*arguments: str) -> Result:
        return CliRunner().invoke(main, arguments)

    return call


HUGE = "99999999999999999999"


def test_a_run_in_json_has_what_scripts_rely_on(slamhive):
    (run,) = json.loads(slamhive("run", "tiny", "track", "--set", "seconds=1", "--json").stdout)
    promised = "id algorithm dataset parameters executor state reason created_at started_at ended_at poses protocol"
    assert set(promised.split()) | {"metrics"} <= set(run)
    assert (run["state"], run["parameters"]["seconds"], run["metrics"]) == ("queued", 1.0, {})
    assert json.loads(slamhive("runs", "--json").stdout) == [run]
    assert json.loads(slamhive("runs", "--state", "failed", "--json").stdout) == []


def test_a_queued_run_says_who_will_take_it(slamhive):
    assert "no worker is running here" in slamhive("run", "tiny", "track").stderr


@pytest.mark.integration
def test_lists_and_shows_speak_json(slamhive):
    slamhive("run", "tiny", "track")
    assert json.loads(slamhive("algorithm", "list", "--json").stdout)[0]["name"] == "tiny"
    shown = json.loads(slamhive("algorithm", "show", "tiny", "--json").stdout)
    assert shown["parameters"]["seconds"]["unit"] == "s"
    assert shown["package"]["name"] == "tiny"
    assert json.loads(slamhive("dataset", "list", "--json").stdout)[0]["duration_s"] == 10.0
    assert json.loads(slamhive("dataset", "show", "track", "--json").stdout)["sensors"][0]["kind"] == "lidar"
    assert Path(json.loads(slamhive("dataset", "show", "track", "--json").stdout)["folder"]).name == "track"
    assert json.loads(slamhive("runs", "show", "1", "--json").stdout)["events"][0]["to"] == "queued"
    checks = {check["name"]: check for check in json.loads(slamhive("doctor", "--json").stdout)}
    assert checks.keys() >= {"database", "worker", "protections process"}
    assert "processes" in checks["protections process"]["found"]
    assert json.loads(slamhive("settings", "--json").stdout)[0]["name"] == "MODE"


def test_cancel_and_retry(slamhive):
    slamhive("run", "tiny", "track")
    assert slamhive("runs", "cancel", "1").stdout == "run 1: cancelled\n"
    (again,) = json.loads(slamhive("runs", "retry", "1", "--json").stdout)
    assert (again["id"], again["retry_of"]) == (2, 1)


def test_tables_are_for_people(slamhive):
    slamhive("run", "tiny", "track", "--repeat", "2")
    listing = slamhive("runs")
    assert "2 of 2 runs" in listing.stderr
    assert listing.stdout.splitlines()[0].split()[:3] == ["id", "algorithm", "dataset"]
    assert (
        "int" in slamhive("algorithm", "show", "tiny").stdout or "float" in slamhive("algorithm", "show", "tiny").stdout
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "tinny", "track"), "unknown algorithm 'tinny'; did you mean 'tiny'?"),
        (("run", "tiny", "trak"), "unknown dataset 'trak'; did you mean 'track'?"),
        (("run", "tiny", "../../etc"), "unknown dataset '../../etc'"),
        (("run", "tiny", "track", "--set", "second=1"), "did you mean 'seconds'?"),
        (("run", "tiny", "track", "--set", "seconds"), "--set 'seconds' is not KEY=VALUE"),
        (("run", "tiny", "track", "--set", "seconds=a", "--set", "seconds=b"), "--set seconds is given twice"),
        (("run", "tiny", "track", "--set", "seconds=99"), "expected float, 0 to 60 s"),
        (("run", "tiny", "track", "--executor", "podman"), "unknown executor 'podman'"),
        (("runs", "show", "7"), "unknown run 7"),
        (("runs", "log", "7"), "unknown run 7"),
        (("runs", "show", HUGE), f"unknown run {HUGE}"),
        (("runs", "log", HUGE), f"unknown run {HUGE}"),
        (("runs", "cancel", HUGE), f"unknown run {HUGE}"),
        (("runs", "retry", HUGE), f"unknown run {HUGE}"),
        (("evaluate", HUGE), f"unknown run {HUGE}"),
        (("run", "tiny", "track", "--memory", HUGE), f"memory limit in MB {HUGE} is not allowed"),
        (("run", "tiny", "track", "--repeat", HUGE), f"repeat {HUGE} is not allowed"),
        (("run", "tiny", "track", "--seed", HUGE), f"seed {HUGE} is not allowed"),
        (("run", "tiny", "track", "--priority", HUGE), f"priority {HUGE} is not allowed"),
        (("run", "tiny", "track", "--rate", "nan"), "playback rate nan is not allowed"),
        (("dataset", "room", "--seed", HUGE), HUGE),
        (("dataset", "room", "--seconds", "inf"), "inf"),
        (("runs", "cancel", "7"), "unknown run 7"),
        (("runs", "--sort", "ate.rmsee"), "ate.rmse"),
        (("evaluate",), "name the runs to evaluate, or give --all-unevaluated"),
        (("evaluate", "7"), "unknown run 7"),
        (("algorithm", "build"), "name the algorithms to build"),
        (("algorithm", "show", "nope"), "unknown algorithm 'nope'"),
        (("dataset", "show", "nope"), "unknown dataset 'nope'"),
        (("dataset", "import", ".", "--format", "kiti", "--name", "x"), "unknown dataset importer 'kiti'"),
        (("dataset", "import", "/nowhere", "--name", "x"), "/nowhere does not exist"),
        (("dataset", "import", ".", "--name", "a/b"), "dataset name 'a/b' is not allowed"),
        (("dataset", "import", ".", "--name", "track"), "dataset 'track' exists already"),
        (("dataset", "room", "--seconds", "-1"), "-1"),
        (("--database-url", "oracle://x", "runs"), "oracle"),
        (("runs", "show", "\udcff"), "argument 3 holds the character U+DCFF, half of a surrogate pair"),
        (("--data", "/tmp/\udcff", "runs"), "argument 2 holds the character U+DCFF"),
        (("run", "tiny", "a\x00b"), "argument 3 holds the character U+0000, a control character"),
        (("run", "tiny", "track", "--set", "seconds=\x1b[31m"), "argument 5 holds the character U+001B"),
        (("runs", "show", "9" * 4420), "is not a valid integer"),
        (("runs", "--limit", "9" * 4420), "is not a valid integer"),
        (("run", "tiny", "track", "--set", f"seconds={'9' * 4420}"), "expected float, 0 to 60 s"),
        (("--data", "/proc/nowhere", "runs"), "data root /proc/nowhere does not exist"),
        (("--data", "/proc/nowhere", "dataset", "room"), "cannot be used"),
    ],
)
def test_each_mistake_gets_one_line_and_exit_code_1(slamhive, arguments, message):
    result = slamhive(*arguments)
    assert result.exit_code == 1, result.output
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    assert message in line


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: b"", "is empty (0 bytes)"),
        (lambda data: data[: len(data) // 2], "cannot be read as a recording"),
        (lambda data: b"no bag at all", "cannot be read as a recording"),
        (lambda data: data.replace(b"/points", b"/pointz"), "holds no messages on /points, which tiny needs as points"),
    ],
)
def test_a_bad_recording_is_refused_before_anything_is_queued(slamhive, tmp_path, change, message):
    bag = tmp_path / "data" / "datasets" / "track" / "track.bag"
    bag.write_bytes(change(bag.read_bytes()))
    result = slamhive("run", "tiny", "track")
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert message in line
    assert "codec" not in line
    assert "('" not in line
    assert json.loads(slamhive("runs", "--json").stdout) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "tiny", "track", "--repeat", "abc"), "'abc' is not a valid integer; see slamhive run --help"),
        (("runs", "show", "abc"), "see slamhive runs show --help"),
        (("run", "tiny"), "Missing argument 'DATASET'"),
        (("nope",), "No such command 'nope'"),
        (("--nope",), "No such option"),
    ],
)
def test_usage_errors_are_one_line_too(slamhive, arguments, message):
    result = slamhive(*arguments)
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    assert message in line


def test_a_package_without_requirements_hides_only_itself(slamhive, tmp_path):
    (tmp_path / "project" / "algorithms" / "tiny" / "requirements.txt").unlink()
    listing = slamhive("algorithm", "list")
    assert listing.exit_code == 0
    assert "not available" in listing.stdout
    assert "requirements.txt" in json.dumps(json.loads(slamhive("doctor", "--json").stdout))
    refused = slamhive("run", "tiny", "track")
    assert refused.exit_code == 1
    assert "use an executor of containers; slamhive doctor --all lists them" in refused.stderr


@pytest.mark.integration
def test_what_is_shown_and_left_out_is_said_in_words(slamhive):
    assert slamhive("runs").stderr == "No runs yet.\n"
    slamhive("run", "tiny", "track")
    slamhive("run", "tiny", "track", "--seed", "7")
    assert slamhive("runs", "--algorithm", "nope").stderr == (
        "No run matches: algorithm nope, newest first. Left out: 2 runs that the filter does not match.\n"
    )
    found = slamhive("runs", "--where", "seed = 7 or ate.rmse < 1", "--sort", "ate.rmse", "--ascending")
    assert found.stderr == (
        "Showing 1 of 1 run: seed 7 or ATE RMSE below 1 m, sorted by ATE RMSE, smallest first. "
        "Left out: 1 run that the filter does not match. 2 runs have no ATE RMSE.\n"
    )


@pytest.mark.integration
def test_configurations_are_exported_in_every_form(slamhive, tmp_path):
    slamhive("run", "tiny", "track", "--repeat", "2")
    slamhive("run", "tiny", "track", "--set", "seconds=1")
    grouped = ("runs", "--group", "configuration")
    shown = slamhive(*grouped)
    assert "Showing 2 configurations with 3 runs: newest first." in shown.stderr
    lines = slamhive(*grouped, "--csv", "--columns", "cpu.mean").stdout.splitlines()
    assert lines[0].startswith(
        "configuration,algorithm,dataset,parameters,runs,failed,protocol,disturbed,all_runs,cpu.mean.mean,cpu.mean.std"
    )
    assert [line.split(",")[0] for line in lines[1:]] == ["2", "1"]
    rows = json.loads(slamhive(*grouped, "--json", "--limit", "1").stdout)
    assert [(row["configuration"], row["runs"], row["ate.rmse.mean"]) for row in rows] == [(2, 1, None)]
    assert slamhive(*grouped, "--csv", "--json").exit_code == 1


def test_a_parquet_file_is_told_in_one_line(slamhive, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed; enable: pip install pyarrow")
    slamhive("run", "tiny", "track", "--repeat", "2")
    path = tmp_path / "runs.parquet"
    written = slamhive("runs", "--where", "seed >= 0", "--parquet", str(path))
    assert written.stdout == f"{path}: 2 runs, seed at least 0, newest first\n"
    assert parquet.read_table(path).num_rows == 2
    grouped = slamhive("runs", "--group", "configuration", "--parquet", str(path))
    assert grouped.stdout == f"{path}: 1 row, newest first\n"
    assert parquet.read_table(path).column("runs").to_pylist() == [2.0]


@pytest.mark.parametrize(
    "arguments",
    [
        ("dataset", "remove", "track", "--yes"),
        ("dataset", "room", "--name", "new"),
        ("algorithm", "build", "tiny"),
        ("reindex",),
        ("demo", "--no-serve"),
    ],
)
def test_view_only_changes_nothing(slamhive, tmp_path, monkeypatch, arguments):
    monkeypatch.setenv("SLAMHIVE_MODE", "view-only")
    result = slamhive(*arguments)
    assert result.exit_code == 1
    assert "view-only" in result.stderr
    assert [folder.name for folder in (tmp_path / "data" / "datasets").iterdir()] == ["track"]


def test_html_in_a_name_is_only_text(slamhive):
    assert "'<script>'" in slamhive("run", "tiny", "<script>").stderr


def test_every_command_has_help():
    def walk(command, path):
        result = CliRunner().invoke(root, [*path, "--help"])
        assert result.exit_code == 0
        assert command.help, path
        for name, child in getattr(command, "commands", {}).items():
            walk(child, [*path, name])

    walk(root, [])


def test_lists_name_the_numbers_that_published_files_use(slamhive):
    before = json.loads(slamhive("algorithm", "list", "--json").stdout)
    assert before[0]["number"] is None, "no configuration has used it yet"
    slamhive("run", "tiny", "track")
    for kind in ("algorithm", "dataset"):
        assert json.loads(slamhive(kind, "list", "--json").stdout)[0]["number"] == 1
        assert slamhive(kind, "list").stdout.splitlines()[0].split()[0] == "no."


def test_a_long_licence_keeps_the_list_of_algorithms_narrow(slamhive, tmp_path):
    file = tmp_path / "project" / "algorithms" / "tiny" / "algorithm.yaml"
    long = "MIT (this, that and the other part), BSD-3-Clause (all of the rest), GPL-3.0-or-later (its plug-ins)"
    file.write_text(file.read_text().replace("licence: GPL-3.0-or-later", f"licence: {long}"))
    listing = slamhive("algorithm", "list").stdout
    assert "MIT, BSD-3-Clause, GPL-3.0-or…" in listing
    assert max(map(len, listing.splitlines())) <= 100
    assert long in slamhive("algorithm", "show", "tiny").stdout
    assert json.loads(slamhive("algorithm", "list", "--json").stdout)[0]["package"]["licence"] == long


def test_cut_columns_end_with_dots_and_rows_stay_one_line(capsys, monkeypatch):
    monkeypatch.setattr("slamhive.cli.output.PIPED_WIDTH", 40)
    print_table(("name", "title"), [("a" * 20, "words " * 8)], cut=("title",))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert "…" in lines[1]
    assert max(map(len, lines)) <= 40


def test_a_narrow_terminal_goes_without_the_least_columns():
    columns = ("id", "algorithm", "state", "time s")
    rows = [(1, "orb-slam3-stereo", "succeeded", "16.0")]
    assert columns_to_leave_out(columns, rows, ("time s",), 80) == []
    assert columns_to_leave_out(columns, rows, ("time s",), 34) == ["time s"]
    assert columns_to_leave_out(columns, rows, ("time s", "state"), 20) == ["time s", "state"]


@pytest.mark.integration
def test_the_doctor_first_says_that_one_can_start_then_what_is_not_fine(slamhive):
    brief, full = slamhive("doctor"), slamhive("doctor", "--all")
    first, heading, *rows = brief.stdout.splitlines()
    assert first.startswith("this machine can start, runs use process, as set")
    assert heading.split() == ["what", "verdict", "found", "remedy"]
    checks = json.loads(slamhive("doctor", "--json").stdout)
    # Another test may have built the package already. An executor that is not in force is no fault.
    expected = [
        check["name"].split()[0]
        for check in checks
        if check["verdict"] != "ok" and not check["name"].startswith("executor ")
    ]
    assert [row.split()[0] for row in rows if not row.startswith(" ")] == expected
    assert "worker" in expected
    assert brief.stderr == "slamhive doctor --all also shows what is fine\n"
    assert full.stdout.startswith(first)
    assert {check["name"].split()[0] for check in checks} <= {row.split()[0] for row in full.stdout.splitlines() if row}


@pytest.mark.integration
def test_the_doctor_says_first_what_prevents_a_start(slamhive, monkeypatch):
    monkeypatch.setenv("SLAMHIVE_EXECUTOR", "slurm")
    ended = slamhive("doctor")
    assert ended.exit_code == 1
    assert ended.stdout.startswith("this machine cannot start yet: executor: ")
    monkeypatch.setenv("SLAMHIVE_EXECUTOR", "process")
    monkeypatch.setenv("SLAMHIVE_MIN_FREE_DISK_MB", "999999999")
    assert "cannot start yet: data root: " in slamhive("doctor").stdout.splitlines()[0]


@pytest.mark.integration
def test_the_doctor_lists_what_is_broken_of_a_machine_that_can_start(slamhive, tmp_path):
    broken = tmp_path / "project" / "algorithms" / "broken"
    broken.mkdir()
    (broken / "algorithm.yaml").write_text("format: 99\n")
    ended = slamhive("doctor")
    assert ended.exit_code == 1
    assert ended.stdout.splitlines()[0].endswith(", but 1 check failed")
    assert "folder broken" in ended.stdout


@pytest.mark.integration
def test_the_doctor_counts_packages_that_are_not_built_in_one_row(slamhive, tmp_path):
    algorithms = tmp_path / "project" / "algorithms"
    for name in ("second", "third"):
        shutil.copytree(algorithms / "tiny", algorithms / name)
        file = algorithms / name / "algorithm.yaml"
        renamed = file.read_text().replace("package: tiny", f"package: {name}").replace("  lidar:\n", f"  {name}:\n", 1)
        file.write_text(renamed)
        (algorithms / name / "requirements.txt").write_text(f"# {name}, {tmp_path}\n")
    rows = slamhive("doctor").stdout.splitlines()
    (row,) = [row for row in rows if row.startswith("algorithm")]
    assert "packages are not built yet" in row
