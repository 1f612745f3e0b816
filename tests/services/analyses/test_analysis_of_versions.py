"""Analyses tell the versions of a package apart: as a filter of the selection, and as the column that groups runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.analysis.chart import Bars
from slamhive.analysis.report import Report
from slamhive.services.analysis.run import AnalysisLimits
from slamhive.services.hive import Hive
from slamhive.store import AlgorithmVersion, RunFields, Transaction
from tests.web.web_world import NOW, add_runs, evaluate_run, finish_run, make_hive

pytestmark = pytest.mark.integration

ATE_M = {1: (0.10, 0.12), 2: (0.20, 0.22)}
"""The errors of the runs of each version."""


@pytest.fixture
def world(tmp_path: Path, sqlite_template: Path) -> Iterator[Hive]:
    """Two runs of each version."""
    hive = make_hive(tmp_path, template=sqlite_template)
    for number, errors_m in ATE_M.items():
        used = AlgorithmVersion(f"sha256:{str(number) * 64}", "sha256:" + "f" * 64, "1.0")
        for run_id, ate_m in zip(add_runs(hive, len(errors_m)), errors_m, strict=True):
            finish_run(hive, run_id)
            evaluate_run(hive, run_id, ate_m)
            assert note_version(hive, run_id, used) == number
    yield hive
    hive.close()


def note_version(hive: Hive, run_id: int, used: AlgorithmVersion) -> int:
    """Note which version a run used; its number."""

    def work(t: Transaction) -> int:
        row, number = t.versions.put("eye-slam", used, NOW)
        t.runs.update(run_id, **RunFields(algorithm_version_id=row))
        return number

    return hive.store.write(work)


def report_of(hive: Hive, where: str) -> Report:
    text = f"name: n\nselect: {{some: {{where: '{where}'}}}}\nforms: [{{form: by_algorithm, by: version}}]\n"
    return hive.analyses.compute(hive.analyses.read(text), AnalysisLimits(runs=10, time_s=60))


@pytest.mark.parametrize("where", ["algorithm = eye-slam-stereo@2", "package = eye-slam@2", "version = 2"])
def test_a_selection_names_a_version(world: Hive, where: str) -> None:
    report = report_of(world, where)
    assert report.runs == len(ATE_M[2])


def test_runs_are_grouped_by_version(world: Hive) -> None:
    (plot,) = report_of(world, "id >= 1").forms
    assert plot.result is not None
    chart = plot.result.charts[0]
    (bars,) = chart.marks
    assert isinstance(bars, Bars)
    assert chart.x.label == "Version"
    assert chart.x.categories == ("eye-slam@1", "eye-slam@2")
    assert list(bars.heights) == pytest.approx([0.11, 0.21])


def test_versions_are_not_mixed_in_silence(world: Hive) -> None:
    report = report_of(world, "id >= 1")
    assert report.mixed_versions == {"eye-slam-stereo": ("eye-slam@1", "eye-slam@2")}
    (plot,) = report.forms
    assert plot.result is not None
    assert "Several versions together: eye-slam-stereo (eye-slam@1, eye-slam@2)." in plot.result.charts[0].caption
    assert report_of(world, "version = 2").mixed_versions == {}
