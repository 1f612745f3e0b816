"""``slamhive experiment`` on an installation with the test algorithm."""

from __future__ import annotations

import csv
import json
import platform
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli.main import main
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.integration

FOUR = """\
name: four
algorithms: tiny
datasets: track
parameters: {behaviour: good | crash, seconds: 0 | 0.01}
"""


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    make_project(tmp_path / "project")
    make_dataset(tmp_path / "data")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)
    path = tmp_path / "four.yaml"
    path.write_text(FOUR)
    return path


def call(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_an_experiment_from_plan_to_report(file: Path, tmp_path: Path) -> None:
    plan = call("experiment", "plan", file)
    assert plan.exit_code == 0, plan.output
    assert "four: 4 combinations, 4 configurations" in plan.output
    assert json.loads(call("experiment", "plan", file, "--json").stdout)["runs"] == 4
    cluster = call("experiment", "plan", file, "--nodes", "2").stdout
    assert "on 2 nodes, by the length of the recordings and 5 s to start" in cluster
    assert "data to move: " in cluster
    assert "is repeated" not in plan.output
    file.write_text(FOUR + "repeat_disturbed: 2\n")
    assert "disturbed runs: each is repeated up to 2 times" in call("experiment", "plan", file).output
    file.write_text(FOUR)
    assert call("experiment", "list").stdout == ""

    started = call("experiment", "start", file, "--wait")
    assert started.exit_code == 1, "two of four fail"
    assert "four: finished; 4 runs of 4 configurations: 2 good, 2 failed" in started.output
    assert "failed: nonzero exit 2" in started.output
    assert "runs: 4 of 4, 2 failed (100%" in started.output, "no time is left when all have ended"

    rows = call("experiment", "report", file).stdout.splitlines()
    assert rows[0].split()[:3] == ["cell", "behaviour", "seconds"]
    assert "nonzero_exit 1" in rows[3]
    table = tmp_path / "report.csv"
    assert call("experiment", "report", "four", "--csv", table).exit_code == 0
    with table.open() as stream:
        found = list(csv.DictReader(stream))
    assert [row["good"] for row in found] == ["1", "1", "0", "0"]
    assert [bool(row["ate.rmse.mean"]) for row in found] == [True, True, False, False]
    cells = json.loads(call("experiment", "report", "four", "--json").stdout)
    assert [cell["values"]["behaviour"] for cell in cells] == ["good", "good", "crash", "crash"]

    assert "2 runs queued again" in call("experiment", "retry-failed", "four").stdout
    assert "0 runs queued again" in call("experiment", "retry-failed", file).stdout


def test_a_published_combination_is_converted_and_planned(file: Path, tmp_path: Path) -> None:
    published = tmp_path / "published.yaml"
    one = (
        "-----\ntiny+track+trial\n-----\nAlgorithm: tiny\nbehaviour: good | crash\nseconds: 0 | 0.01\n-----\n\n-----\n"
    )
    published.write_text(one)
    made = tmp_path / "made.yaml"
    assert call("experiment", "convert", published, "--out", made).exit_code == 0
    assert "tiny-track-trial: 4 combinations" in call("experiment", "plan", made).stdout
    assert call("experiment", "convert", published).stdout == made.read_text()
    assert "made.yaml exists already" in call("experiment", "convert", published, "--out", made).stderr
    published.write_text(one + one)
    assert "holds 2 combinations" in call("experiment", "convert", published).stderr
    assert call("experiment", "convert", published, "--out", tmp_path / "both").exit_code == 0
    assert sorted(path.name for path in (tmp_path / "both").iterdir()) == [
        "tiny-track-trial-2.yaml",
        "tiny-track-trial.yaml",
    ]


def test_pausing_repeating_and_cancelling(file: Path) -> None:
    assert call("experiment", "start", file).exit_code == 0
    assert "four: paused" in call("experiment", "pause", "four").stdout
    assert "8 runs of 4 configurations" in call("experiment", "add-repeats", "four", 1).stdout
    assert "four: active" in call("experiment", "resume", "four").stdout
    assert json.loads(call("experiment", "status", "four", "--json").stdout)["counts"]["queued"] == 8
    assert "four" in call("experiment", "status").stdout
    assert "8 cancelled" in call("experiment", "cancel", "four").stdout
    assert call("experiment", "status").stdout == ""
    (line,) = (row for row in call("experiment", "list").stdout.splitlines() if row.split()[1:2] == ["four"])
    assert line.split()[:3] == ["1", "four", "cancelled"]


@pytest.mark.parametrize(
    ("arguments", "text", "message"),
    [
        (("plan",), FOUR.replace("track", "trakc"), "four.yaml line 3: unknown dataset 'trakc'"),
        (("start",), "", "four.yaml"),
        (("start", "--executor", "dokcer"), FOUR, "dokcer"),
        (("status",), FOUR, "unknown experiment 'four'"),
    ],
)
def test_mistakes_end_in_one_line(file: Path, arguments: tuple[str, ...], text: str, message: str) -> None:
    file.write_text(text)
    result = call("experiment", arguments[0], file, *arguments[1:])
    assert result.exit_code == 1
    (line,) = result.stderr.strip().splitlines()
    assert line.startswith("error: ")
    assert message in line


@pytest.mark.usefixtures("file")
def test_nodes_are_listed_and_this_machine_is_not_drained() -> None:
    assert call("reindex").exit_code == 0
    listed = call("nodes")
    assert listed.exit_code == 0, listed.output
    assert platform.node() in listed.stdout
    assert listed.stdout.endswith("\n0 runs queued\n"), "no experiment is active"
    assert json.loads(call("nodes", "--json").stdout)["asks_engines"] is True
    for action in ("drain", "undrain"):
        refused = call("nodes", action, platform.node())
        assert refused.exit_code == 1
        assert "cannot drain" in refused.output
    assert "unknown node 'moon'" in call("nodes", "drain", "moon").output
