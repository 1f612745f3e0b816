"""The table of metrics: mean and spread by algorithm and dataset, failures counted, a protocol for each row."""

from __future__ import annotations

import numpy as np
import pytest

from slamhive.analysis.plot_types import PLOT_TYPES
from slamhive.analysis.plot_types.metric_table import mean_and_std
from slamhive.analysis.result import PlotResult
from slamhive.analysis.statistics import summarise
from slamhive.analysis.table import RunTable
from slamhive.errors import InvalidInput
from slamhive.services.markdown_table import table_markdown
from slamhive.services.reports.tables import table_latex
from tests.analysis.analysis_world import ALGORITHMS, DATASETS, data_of, sweep_table

pytestmark = pytest.mark.integration  # plotting and statistics take seconds to load


def build(table: RunTable, **options: object) -> PlotResult:
    chosen = PLOT_TYPES.get("table")
    return chosen.build(data_of(table), chosen.options(**options))


def shown(result: PlotResult) -> list[dict[str, object]]:
    table = result.tables[0]
    return [dict(zip((column.heading for column in table.columns), row, strict=True)) for row in table.rows]


def test_a_row_for_each_algorithm_and_dataset() -> None:
    table = sweep_table()
    result = build(table, metrics=["ate.rmse", "ram.max"])
    rows = shown(result)
    assert [(row["Dataset"], row["Algorithm"]) for row in rows] == [(d, a) for d in DATASETS for a in ALGORITHMS]
    orb = next(row for row in rows if row["Algorithm"] == "orb-slam3-stereo" and row["Dataset"] == "room")
    chosen = (table.frame["algorithm"] == "orb-slam3-stereo") & (table.frame["dataset"] == "room")
    values = table.frame[chosen]["ate.rmse"].dropna()
    assert (orb["Runs"], orb["Failed"]) == (40, 8)
    assert orb["ATE RMSE [m]"] == f"{values.mean():.3f} ± {values.std():.3f}"
    assert str(orb["RAM max [MB]"]).startswith("188 ± ")
    assert "SE(3)" in result.tables[0].caption
    assert r"$\pm$" in table_latex(result.tables[0])
    lines = table_markdown(result.tables[0]).splitlines()
    assert lines[0].startswith("| Dataset | Algorithm | Runs | Failed | ATE RMSE \\[m\\] |")
    assert lines[1] == "| --- | --- | ---: | ---: | --- | --- |"
    assert lines[2].startswith("| kitti\\_06 | kiss-icp | 40 | 0 | ")


def test_rows_may_have_different_protocols_but_no_row_mixes_them() -> None:
    frame = sweep_table().frame
    mono = (frame["algorithm"] == "orb-slam3-stereo") & frame["protocol"].notna()
    labels = np.where(mono, "Sim(3)", frame["protocol_label"])
    table = sweep_table(protocol=list(np.where(mono, "bbbbbbbbbbbb", frame["protocol"])), protocol_label=list(labels))
    rows = shown(build(table, metrics=["ate.rmse"]))
    assert {(row["Algorithm"], row["Protocol"]) for row in rows} == {
        ("kiss-icp", "SE(3)"),
        ("rko-lio", "SE(3)"),
        ("orb-slam3-stereo", "Sim(3)"),
    }
    one = table.with_rows(table.frame.assign(algorithm="one"))
    with pytest.raises(InvalidInput, match="2 protocols, which are never mixed"):
        build(one, metrics=["ate.rmse"])


def test_a_group_without_a_good_run_has_no_value() -> None:
    table = sweep_table(state=["failed"] * len(sweep_table().frame))
    assert {row["ATE RMSE [m]"] for row in shown(build(table, metrics=["ate.rmse"]))} == {None}


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([300.0, 300.0], "300 ± 0"),
        ([300.0], "300"),
        ([298.0, 299.0], "298.5 ± 0.7"),
        ([0.0312, 0.0320], "0.0316 ± 0.0006"),
        ([0.0312, 0.031201], "0.0312 ± 0.0000"),
        ([12345.0, 12000.0], "12172 ± 244"),
        ([0.0, 0.0], "0 ± 0"),
        ([0.0, 3.0], "1.50 ± 2.12"),
    ],
)
def test_digits_fit_the_spread(values: list[float], text: str) -> None:
    summary = summarise(np.array(values))
    assert summary is not None
    assert mean_and_std(summary) == text
