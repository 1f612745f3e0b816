"""The table of metrics: mean and spread by algorithm and dataset, failures counted, a protocol for each row."""

from __future__ import annotations

import re

import numpy as np
import pytest

from slamhive.analysis.plot_types import PLOT_TYPES
from slamhive.analysis.plot_types.metric_table import _Entry, ranks
from slamhive.analysis.report import PlotResult
from slamhive.analysis.statistics import summarise
from slamhive.analysis.table import RunTable
from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import Direction
from slamhive.domain.names import mean_and_std, value_within
from slamhive.services.analysis.bundle import table_latex
from slamhive.services.markdown import table_markdown
from tests.analysis.analysis_world import ALGORITHMS, DATASETS, RATES, data_of, sweep_table

pytestmark = pytest.mark.integration  # plotting and statistics take seconds to load


def build(table: RunTable, **options: object) -> PlotResult:
    chosen = PLOT_TYPES.get("table")
    return chosen.build(data_of(table), chosen.options(**options))


def shown(result: PlotResult) -> list[dict[str, object]]:
    table = result.tables[0]
    return [dict(zip((column.heading for column in table.columns), row, strict=True)) for row in table.rows]


def test_groups_of_numbers_are_in_their_order() -> None:
    table = sweep_table()
    in_order = [f"{rate:g}" for rate in sorted(RATES)]
    rows = [row[0] for row in build(table, metrics=["ate.rmse"], by="image_rate").tables[0].rows]
    assert list(dict.fromkeys(rows)) == in_order
    grid = build(table, metrics=["ate.rmse"], by="image_rate", columns="algorithms").tables[0]
    assert [row[0] for row in grid.rows] == in_order
    for name in ("by_algorithm", "distributions"):
        chosen = PLOT_TYPES.get(name)
        result = chosen.build(data_of(table), chosen.options.model_validate({"by": "image_rate"}))
        assert result.charts[0].x.categories == tuple(in_order)


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
    assert lines[1] == "| --- | --- | ---: | ---: | ---: | ---: |"
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
    with pytest.raises(InvalidInput, match=r"ate.rmse: \d+ runs use SE\(3\).*: not comparable"):
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
        ([0.0312, 0.031201], "0.0312 ± 7.1e-07"),
        ([12345.0, 12000.0], "12172 ± 244"),
        ([0.0, 0.0], "0 ± 0"),
        ([0.0, 3.0], "1.50 ± 2.12"),
    ],
)
def test_digits_fit_the_spread(values: list[float], text: str) -> None:
    summary = summarise(np.array(values))
    assert summary is not None
    assert mean_and_std(summary.mean, summary.std) == text


@pytest.mark.parametrize(
    ("value", "half_width", "text"),
    [
        (0.0312, 0.0008, "0.0312 ± 0.0008"),
        (4.31e-5, 0.0123, "0.000 ± 0.012"),
        (-1.2e-9, 0.01, "0.000 ± 0.010"),
        (-0.004, 0.0123, "-0.004 ± 0.012"),
        (3.0, 250.0, "3 ± 250"),
        (0.0, 0.0, "0 ± 0"),
    ],
)
def test_a_value_has_no_digits_beyond_those_of_its_interval(value: float, half_width: float, text: str) -> None:
    assert value_within(value, half_width) == text


def test_a_paper_has_sequences_by_algorithms_with_the_best_marked() -> None:
    table = sweep_table()
    result = build(table, metrics=["ate.rmse", "cpu.mean"], columns="algorithms")
    first, second = (entry for entry in result.tables if not entry.raw)
    assert (first.title, second.title) == ("ATE RMSE [m]", "CPU mean [cores]")
    assert [column.label for column in first.columns] == ["Dataset", *ALGORITHMS]
    assert [row[0] for row in first.rows] == list(DATASETS)
    assert [entry[1:] for entry in first.ranks] == [(1, None, 2)] * len(DATASETS), "ORB-SLAM3 fails at times"
    assert all(str(row[2]).endswith(" (32/40)") for row in first.rows)
    for part in ("336 of 360 runs, 24 failed", "lower is better", "of 40 in each cell", "(a/b)", "Protocol: SE(3)"):
        assert part in first.caption
    latex = table_latex(first)
    assert r"\begin{tabular}{lrrr}" in latex
    row = next(line for line in latex.splitlines() if line.startswith(r"kitti\_06"))
    assert row.count(r"\textbf{") == row.count(r"\underline{") == 1
    assert r"\caption{ATE RMSE [m]. n = 336 of 360 runs, 24 failed." in latex
    assert "Protocol: SE(3)" in latex.partition(r"\begin{tabular}")[0]
    assert re.search(r" \$[\d.]+ \\pm [\d.]+\$ \(32/40\) ", row)
    assert all(part in table_markdown(first) for part in ("**", "<ins>"))


def test_what_failed_everywhere_or_never_ran_has_a_mark_and_no_rank() -> None:
    whole = sweep_table()
    lost = (whole.frame["dataset"] == "room") & (whole.frame["algorithm"] == "kiss-icp")
    frame = whole.frame[~((whole.frame["dataset"] == "v101") & (whole.frame["algorithm"] == "rko-lio"))]
    frame = frame.assign(failed=frame["failed"].where(~lost, "diverged"))
    shown_table = build(whole.with_rows(frame), metrics=["ate.rmse"], columns="algorithms").tables[0]
    rows = {row[0]: row[1:] for row in shown_table.rows}
    assert (rows["room"][0], rows["v101"][2]) == ("×", None)
    assert "×: every run failed. –: no value." in shown_table.caption
    assert shown_table.ranks[1] == (None, None, 2, 1)
    assert r" & $\times$ & " in table_latex(shown_table)


def test_a_ranking_never_mixes_protocols() -> None:
    frame = sweep_table().frame
    mono = (frame["algorithm"] == "orb-slam3-stereo") & frame["protocol"].notna()
    table = sweep_table(protocol=list(np.where(mono, "bbbbbbbbbbbb", frame["protocol"])))
    with pytest.raises(InvalidInput, match=r"ate.rmse: \d+ runs use SE\(3\).*: not comparable"):
        build(table, metrics=["ate.rmse"], columns="algorithms")
    with pytest.raises(InvalidInput, match="rows and columns at once"):
        build(sweep_table(), metrics=["ate.rmse"], columns="algorithms", by="algorithm")


@pytest.mark.parametrize(
    ("texts", "failed", "direction", "places"),
    [
        (["0.1 ± 0.1", "0.2", "0.3"], [0, 0, 0], Direction.LOWER, [1, 2, None]),
        (["0.1", "0.2", "0.3"], [0, 0, 0], Direction.HIGHER, [None, 2, 1]),
        (["0.1", "0.2", "0.3"], [2, 1, 1], Direction.LOWER, [None, 1, 2]),
        (["0.1", "0.1", "0.3"], [0, 0, 0], Direction.LOWER, [1, 1, None]),
        (["0.1", "0.1", None], [0, 0, 5], Direction.LOWER, [None, None, None]),
        (["0.1", None, None], [0, 5, 5], Direction.LOWER, [None, None, None]),
        (["0.1", "0.2", "0.3"], [0, 0, 0], Direction.NEUTRAL, [None, None, None]),
        ([None, None], [5, 5], Direction.LOWER, [None, None]),
    ],
)
def test_ranks_put_failures_first_and_share_ties(texts, failed, direction, places) -> None:
    entries = [_Entry(5, count, text) for text, count in zip(texts, failed, strict=True)]
    assert ranks(entries, direction) == places
