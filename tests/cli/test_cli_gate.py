"""``slamhive gate``: exit codes, tables, JSON, Markdown and JUnit, and mistakes in one line."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from slamhive.documents.gate import Baseline, GateAnswer
from slamhive.services.markdown import markdown_html
from tests.services.gate_world import add_good, errors_m
from tests.web import web_world as world

pytestmark = pytest.mark.integration  # scipy takes a second to load


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory, sqlite_template: Path) -> Path:
    """A data root with the baseline ``main`` of runs 1 to 8; 9 to 16 are as good, 17 to 24 worse."""
    folder = tmp_path_factory.mktemp("gate")
    hive = world.make_hive(folder, template=sqlite_template)
    for seed, median_m in enumerate((0.05, 0.05, 0.065)):
        add_good(hive, errors_m(8, median_m, seed=seed))
    hive.close()
    data = folder / "data"
    assert gate(data, "baseline", "main", "--where", "id <= 8").exit_code == 0
    return data


def gate(data: Path, *arguments: str) -> Result:
    return CliRunner().invoke(main, ["--data", str(data), "gate", *arguments])


def test_the_exit_code_is_the_answer(data: Path):
    same = gate(data, "check", "main", "--where", "id > 8 and id <= 16")
    assert (same.exit_code, "gate main: pass." in same.stderr) == (0, True), same.output
    worse = gate(data, "check", "main", "--where", "id > 16")
    assert (worse.exit_code, "gate main: worse." in worse.stderr) == (1, True)
    few = gate(data, "check", "main", "--where", "id = 9")
    assert (few.exit_code, "gate main: undecided." in few.stderr) == (3, True)


def test_the_table_names_metric_margin_change_and_answer(data: Path):
    result = gate(data, "check", "main", "--where", "id > 16")
    row = next(line for line in result.stdout.splitlines() if line.startswith("ATE RMSE"))
    assert row.split()[2:4] == ["5", "%"]
    assert row.split()[-1] == "worse"
    assert "eye-slam-stereo on room" in result.stdout


def test_json_follows_its_schema(data: Path):
    content = json.loads(gate(data, "check", "main", "--where", "id > 16", "--json").stdout)
    found = GateAnswer.read(content)
    assert (found.answer, found.baseline) == ("worse", "main")
    assert content == found.content
    shown = Baseline.read(json.loads(gate(data, "show", "main", "--json").stdout))
    assert shown.runs == 8
    (listed,) = json.loads(gate(data, "list", "--json").stdout)
    assert (listed["name"], listed["runs"], listed["algorithms"]) == ("main", 8, ["eye-slam-stereo"])


def test_markdown_and_junit_are_written(data: Path, tmp_path: Path):
    markdown, junit = tmp_path / "gate.md", tmp_path / "gate.xml"
    gate(data, "check", "main", "--where", "id > 16", "--markdown", str(markdown), "--junit", str(junit))
    page = markdown_html(markdown.read_text())
    assert "SLAM Hive gate main: worse</h3>" in page
    assert page.count("<table>") == 2
    suite = ET.parse(junit).getroot().find("testsuite")
    assert suite is not None
    cases = {case.attrib["name"]: case for case in suite.iter("testcase")}
    assert (suite.attrib["tests"], suite.attrib["failures"], suite.attrib["skipped"]) == (str(len(cases)), "1", "0")
    failure = cases["ate.rmse"].find("failure")
    assert failure is not None
    assert failure.attrib["message"].startswith("ATE RMSE changed by +")
    assert cases["ram.max"].find("failure") is None


def test_undecided_metrics_are_skipped_test_cases(data: Path, tmp_path: Path):
    junit = tmp_path / "gate.xml"
    gate(data, "check", "main", "--where", "id = 9", "--junit", str(junit))
    suite = ET.parse(junit).getroot().find("testsuite")
    assert suite is not None
    assert int(suite.attrib["skipped"]) >= 4
    assert suite.attrib["failures"] == "0"


def test_a_baseline_moves_to_another_data_root_as_a_file(data: Path, tmp_path: Path):
    file = tmp_path / "kept.json"
    assert gate(data, "export", "main", str(file)).exit_code == 0
    assert gate(data, "check", str(file), "--where", "id > 16").exit_code == 1
    shown = gate(data, "show", str(file))
    assert "baseline main: 8 runs of 1 configuration" in shown.stdout
    assert "Test CPU" in shown.stdout


def test_a_baseline_is_removed(data: Path):
    gate(data, "baseline", "old", "--where", "id <= 8")
    assert "old" in gate(data, "list").stdout
    assert gate(data, "remove", "old").exit_code == 0
    assert "old" not in gate(data, "list").stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("check", "mian", "--where", "id > 8"), "unknown baseline 'mian'"),
        (("check", "main"), "name the runs to check by --where, or start them by --run"),
        (("check", "main", "--where", "id > 8", "--run", "eye-slam-stereo"), "one of the two"),
        (("check", "main", "--where", "id > 8", "--budget", "20 runs"), "--budget is for runs that the check starts"),
        (("check", "main", "--where", "id > 99"), "no run matches the filter"),
        (("check", "main", "--where", "id >"), "the filter has its end where a value belongs"),
        (("check", "main", "--where", "id > 8", "--margin", "ate.rmse=much"), "margin 'much' of ate.rmse"),
        (("check", "main", "--run", "eye-slam-stereo", "--budget", "much"), "budget 'much' is not clear"),
        (("check", "main", "--where", "id > 8", "--junit", "/none/gate.xml"), "folder /none does not exist"),
        (("check", "none.json", "--where", "id > 8"), "none.json does not exist"),
        (("check", "main", "--nonsense"), "No such option"),
        (("--nonsense",), "No such option"),
        (("baseline", "main", "--where", "id > 8"), "baseline main exists already"),
        (("baseline", "a/b", "--where", "id > 8"), "baseline name 'a/b' is not allowed"),
    ],
)
def test_a_mistake_is_one_line_with_an_exit_code_of_its_own(data: Path, arguments: tuple[str, ...], message: str):
    result = gate(data, *arguments)
    assert (result.exit_code, result.stdout) == (2, ""), result.output
    assert message in result.stderr
    assert result.stderr.splitlines()[-1].startswith("error: ")
