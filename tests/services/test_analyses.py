"""Analyses out of a store: selection by every kind of set, the table, the report, and its files."""

from __future__ import annotations

import json
import zipfile
from io import BytesIO

import pandas as pd
import pytest

from slamhive.analysis.chart import PALETTE
from slamhive.analysis.report import DisturbedRuns, Report, ResultTable, TableColumn
from slamhive.base.errors import InvalidInput, NotFound
from slamhive.base.project import project_root
from slamhive.domain.bibliography import latex
from slamhive.domain.trust import Disturbance, DisturbanceKind, DisturbanceReason
from slamhive.domain.verdict import FailureRule
from slamhive.services.analysis.bundle import Printing, report_page, table_csv, table_latex, write_folder, zipped
from slamhive.services.analysis.run import AnalysisLimits
from slamhive.services.analysis.table import TableRequest, load_table
from slamhive.services.markdown import table_markdown
from tests.web.web_world import add_runs, evaluate_run, fail_run, finish_run, make_hive

pytestmark = pytest.mark.integration

LIMITS = AnalysisLimits(runs=1000, time_s=120)


def test_latex_and_spreadsheets_take_nothing_for_a_command():
    table = ResultTable(
        "t", "a title\nof two lines", (TableColumn("name", "Name_%"),), (("=cmd()",), (r"\input{x} $a$",))
    )
    assert table_csv(table).splitlines() == ["Name_%", "'=cmd()", r"\input{x} $a$"]
    assert table_markdown(table).splitlines()[0] == r"| Name\_% |"
    text = table_latex(table)
    assert r"\textbackslash{}input\{x\} \$a\$" in text
    assert r"\caption{a title of two lines.}" in text
    assert latex("a_b & 5 %") == r"a\_b \& 5 \%"


@pytest.fixture
def world(tmp_path, sqlite_template):
    """Two algorithms, four good runs and a failed one."""
    hive = make_hive(tmp_path, template=sqlite_template)
    good = [*add_runs(hive, 2), *add_runs(hive, 2, "eye-slam-mono")]
    for place, run_id in enumerate(good):
        finish_run(hive, run_id)
        evaluate_run(hive, run_id, 0.04 + 0.01 * place)
    (bad,) = add_runs(hive, 1)
    fail_run(hive, bad)
    yield hive
    hive.close()


def compute(hive, select: str, form: str = "{form: distributions, metrics: [ate.rmse]}", use: str = "") -> Report:
    head = "name: a <b>name</b>\ntext: 'see [x](javascript:alert(1)) <script>'"
    text = f"{head}\nselect: {select}\n{use}\nforms:\n- {form}\n"
    report: Report = hive.analyses.compute(hive.analyses.read(text), LIMITS)
    return report


def test_a_report_counts_names_and_shows(world):
    report = compute(world, "{all: {where: 'id >= 1'}}")
    assert (report.runs, report.failed) == (5, 1)
    assert report.selection == "runs where id >= 1"
    assert report.forms[0].error is None
    page = report_page(report, world.catalogue.project_root)
    assert "<b>name" not in page.split("<script")[0]
    assert 'href="javascript:' not in page
    text = page.split("<script")[0]
    assert "http://" not in text
    assert text.count("counts as failed if") == 1, "captions on the page do not repeat it"
    assert "counts as failed if" in report.forms[0].charts[0].caption, "exported files state it"


def test_disturbed_runs_are_kept_and_told_or_left_out_on_request(world):
    first, *_ = world.store.read(lambda t: t.searches.run_ids(world.searches.read("evaluated = yes")))
    busy = Disturbance(known=True, reasons=(DisturbanceReason(DisturbanceKind.STEAL, "the hypervisor took it"),))
    world.store.write(lambda t: t.runs.update(first, disturbance=busy))
    kept = compute(world, "{all: {where: 'id > 0'}}")
    assert kept.runs == 5
    assert kept.disturbance == DisturbedRuns(disturbed=1, unknown=4, left_out=None)
    assert "1 of 5 runs measured on a disturbed machine" in " ".join(report_page(kept, project_root()).split())
    without = compute(world, "{all: {where: 'id > 0'}}", use="exclude_disturbed: true")
    assert without.runs == 4
    assert without.disturbance == DisturbedRuns(disturbed=0, unknown=4, left_out=1)
    page = " ".join(report_page(without, project_root()).split())
    assert "<strong>1 run left out</strong>: measured on a disturbed machine." in page
    assert "1 run measured on a disturbed machine left out." in page
    with pytest.raises(InvalidInput, match="all 1 runs were measured on a disturbed machine"):
        compute(world, f"{{one: {{runs: [{first}]}}}}", use="exclude_disturbed: true")


def test_a_report_of_before_is_shown_without(world):
    report = compute(world, "{all: {where: 'id > 0'}}")
    content = report.content
    del content["disturbance"], content["unevaluated"]
    report = Report.stored(content)
    assert "disturbed" not in report_page(report, project_root()).split("<script")[0]


def test_sets_and_their_algebra(world):
    report = compute(world, "{a: {runs: [1, 2, 3]}, b: {where: 'algorithm = eye-slam-mono'}}", use="use: a - b")
    assert report.runs == 2
    assert report.selection == "(runs 1, 2, 3) but not (runs where algorithm = eye-slam-mono)"


@pytest.mark.parametrize(
    ("select", "error", "words"),
    [
        ("{a: {where: 'ate.rms < 1'}}", InvalidInput, "line 3: .*did you mean 'ate.rmse'"),
        ("{a: {where: 'ate.rmse < 0'}}", InvalidInput, "the selection holds no run: a holds 0"),
        ("{a: {experiment: nothing}}", NotFound, "line 3: unknown experiment 'nothing'"),
        ("{a: {search: nothing}}", NotFound, "line 3: unknown saved search 'nothing'"),
        ("{a: {group: nothing}}", NotFound, "line 3: unknown group 'nothing'"),
        ("{a: {runs: [1, 99]}}", NotFound, "line 3: unknown runs 99"),
    ],
)
def test_selections_that_cannot_be(world, select, error, words):
    with pytest.raises(error, match=words):
        compute(world, select)


def test_a_protocol_that_nothing_was_evaluated_under_is_told_with_its_line(world):
    with pytest.raises(NotFound, match="line 4: unknown protocol 'sim3'"):
        compute(world, "{a: {where: 'id >= 1'}}", use="protocol: sim3")


def test_a_form_that_does_not_fit_leaves_the_others_alone(world):
    report = compute(world, "{all: {where: 'id >= 1'}}", "{form: heatmap, x: nothing, y: seed}\n- {form: by_algorithm}")
    refused, made = report.forms
    assert "unknown metric or parameter 'nothing'" in (refused.error or "")
    assert refused.result is None
    assert made.error is None


def test_too_many_runs_and_too_little_time_are_refused(world):
    analysis = world.analyses.read("name: n\nselect: {a: {where: 'id >= 1'}}\nforms: [{form: by_algorithm}]")
    with pytest.raises(InvalidInput, match="has 5 runs, 4 are allowed"):
        world.analyses.compute(analysis, AnalysisLimits(4, 120))
    slow = world.analyses.compute(analysis, AnalysisLimits(5, 0))
    assert "takes longer than 0 s" in (slow.forms[0].error or "")


def test_trajectories_and_usage_come_from_the_run_folders(world):
    report = compute(world, "{all: {where: 'id >= 1'}}", "{form: trajectories}\n- {form: usage}")
    assert [form.error for form in report.forms] == [None, None]


def test_the_files_of_a_report(world, tmp_path):
    report = compute(world, "{all: {where: 'id >= 1'}}")
    folder, root = tmp_path / "out", world.catalogue.project_root
    names = {str(path.relative_to(folder)) for path in write_folder(report, root, folder, Printing(["svg"]))}
    assert {"analysis.yaml", "report.html", "references.bib"} <= names
    assert {"figures/01_distribution_ate.rmse.svg", "tables/01_distributions.tex"} <= names
    again = Report.stored(json.loads(json.dumps(report.content)))
    with zipfile.ZipFile(BytesIO(zipped(again, root, Printing([])))) as archive:
        assert archive.testzip() is None
        assert "tables/01_distributions_raw.csv" in archive.namelist()
        raw = pd.read_parquet(BytesIO(archive.read("tables/01_distributions_raw.parquet")))
    assert len(raw) == 5
    assert raw["ate.rmse"].notna().sum() == 4


def test_without_pyarrow_a_report_has_no_parquet(world, monkeypatch):
    monkeypatch.setattr("slamhive.services.analysis.bundle.parquet_there", lambda: False)
    report = compute(world, "{all: {where: 'id >= 1'}}")
    with zipfile.ZipFile(BytesIO(zipped(report, world.catalogue.project_root, Printing([])))) as archive:
        assert not [name for name in archive.namelist() if name.endswith(".parquet")]


def test_parameters_have_their_units_and_algorithms_their_colours(world):
    table = load_table(
        world.store,
        TableRequest([1, 2, 3, 4, 5], {"ate.rmse"}, None, FailureRule()),
        {"another": "mono", "eye-slam-mono": "mono"},
        {},
    )
    assert table.colours["eye-slam-mono"] == PALETTE[0]
    assert set(table.frame["sensors"].dropna()) == {"mono"}
    units = world.store.read(lambda t: t.run_table.units())
    assert {key: table.columns[key].unit for key in units if key in table.columns} == {
        key: unit for key, unit in units.items() if key in table.columns
    }
