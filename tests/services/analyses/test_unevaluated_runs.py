"""Runs that nobody has evaluated are neither good nor failed: they are left out, and the report says so."""

from __future__ import annotations

import pytest

from slamhive.analysis.report import Report
from slamhive.base.errors import InvalidInput
from slamhive.services.analysis.run import AnalysisLimits
from tests.web.web_world import PROTOCOL, add_runs, evaluate_run, finish_run, make_hive

pytestmark = pytest.mark.integration


@pytest.fixture
def world(tmp_path, sqlite_template):
    """Three finished runs."""
    hive = make_hive(tmp_path, template=sqlite_template)
    for run_id in add_runs(hive, 3):
        finish_run(hive, run_id)
    yield hive
    hive.close()


def report_of(hive, protocol: str = "") -> Report:
    text = f"name: n\nselect: {{all: {{where: 'id >= 1'}}}}\n{protocol}\nforms: [{{form: by_algorithm}}]\n"
    report: Report = hive.analyses.compute(hive.analyses.read(text), AnalysisLimits(runs=10, time_s=60))
    return report


@pytest.mark.parametrize("protocol", ["", f"protocol: {PROTOCOL.fingerprint}"])
def test_an_evaluation_that_failed_is_a_failure_and_one_that_is_missing_is_not(world, protocol: str):
    evaluate_run(world, 1)
    evaluate_run(world, 2, reason="alignment is not possible")
    report = report_of(world, protocol)
    assert (report.runs, report.failed, report.unevaluated) == (2, 1, 1)
    assert report.failed_because == {"could not be evaluated": 1}
    assert [(entry.fingerprint, entry.runs) for entry in report.protocols] == [(PROTOCOL.fingerprint, 1)]


def test_nothing_evaluated_is_told(world):
    with pytest.raises(InvalidInput, match="none of the 3 runs has been evaluated") as raised:
        report_of(world)
    assert "evaluate them first" in str(raised.value)
