"""Every form over the table of a sweep: it draws on screen and paper, counts failures, refuses what does not fit."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from slamhive.analysis.analysis_file import parse_analysis
from slamhive.analysis.chart import PALETTE, PRINT_FORMATS, Bars, Cells, FailedRuns, Line, Points, algorithm_colours
from slamhive.analysis.plot_types import RunTrack
from slamhive.analysis.plot_types.scatter import pareto_front
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.analysis.print_chart import print_chart
from slamhive.analysis.report import PlotResult, ResultTable, TableColumn
from slamhive.analysis.table import FAILED as FAILED_COLUMN
from slamhive.analysis.table import Column, ColumnKind
from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.verdict import FailureRule
from slamhive.services.analysis.bundle import table_csv, table_latex, table_parquet
from slamhive.services.markdown import table_markdown
from tests.analysis.analysis_world import ALGORITHMS, DATASETS, RATES, REPEATS, SCALES, NoFiles, data_of, sweep_table

pytestmark = pytest.mark.integration

RUNS = len(ALGORITHMS) * len(DATASETS) * len(RATES) * len(SCALES) * REPEATS
FAILED = len(DATASETS) * len(SCALES) * REPEATS

PLOT_TYPES = {
    "scatter": "x: image_rate, y: ate.rmse",
    "scatter_3d": "x: image_rate, y: scale, z: ate.rmse",
    "distributions": "metrics: [ate.rmse, cpu.mean]",
    "by_algorithm": "of: best",
    "heatmap": "x: image_rate, y: scale",
    "line": "x: image_rate",
    "pareto": "metrics: [cpu.mean, ate.rmse]",
    "critical_difference": "test: nemenyi",
    "coverage": "metric: ate.rmse",
    "sensitivity": "x: image_rate",
    "parallel": "metric: ate.rmse",
    "importance": "metric: ate.rmse",
    "budget": "budgets: [image_rate, scale]",
    "selector": 'bounds: ["ate.rmse < 0.1", "cpu.mean <= 2"]',
}


def build(options: str, **table) -> PlotResult:
    """The form that ``form: NAME, ...`` states, over the sweep."""
    analysis = parse_analysis(f"name: t\nselect: {{a: {{runs: [1]}}}}\nforms:\n- {{{options}}}\n")
    (request,) = analysis.plots
    return request.plot_type.build(data_of(sweep_table(**table)), request.options)


@pytest.mark.parametrize("form", PLOT_TYPES)
def test_every_form_draws_and_counts(form):
    result = build(f"form: {form}, {PLOT_TYPES[form]}")
    assert result.charts
    assert result.failed <= FAILED
    for chart in result.charts:
        assert "A run counts as failed if" in chart.caption
        figure = json.loads(json.dumps(plotly_figure(chart), allow_nan=False))
        assert figure["data"]
    for file_format in PRINT_FORMATS:
        assert len(print_chart(result.charts[0], file_format)) > 1000
    assert any(table.raw and len(table.rows) for table in result.tables)


@pytest.mark.parametrize("form", PLOT_TYPES)
def test_an_empty_selection_is_told(form):
    analysis = parse_analysis(
        f"name: t\nselect: {{a: {{runs: [1]}}}}\nforms:\n- {{form: {form}, {PLOT_TYPES[form]}}}\n"
    )
    (request,) = analysis.plots
    table = sweep_table()
    empty = data_of(table.with_rows(table.frame.iloc[:0]))
    with pytest.raises(InvalidInput, match="contains no run"):
        request.plot_type.build(empty, request.options)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ("form: scatter, x: image_rat, y: ate.rmse", NotFound, "did you mean 'image_rate'"),
        ("form: scatter, x: image_rate, y: algorithm", InvalidInput, "the y axis needs numbers, 'algorithm' is text"),
        ("form: scatter, x: scale, y: scale", InvalidInput, "x and y are both 'scale'"),
        ("form: heatmap, x: run_id, y: scale", InvalidInput, "'run_id' has 360 values"),
        ("form: pareto, metrics: [ate.rmse, image_rate]", InvalidInput, "'image_rate' has no better direction"),
        ("form: pareto, metrics: [ate.rmse, ate.rmse]", InvalidInput, "named twice"),
        ("form: line, x: dataset", InvalidInput, "the x axis needs numbers, .*use for example image_rate, scale"),
        ("form: line, x: image_rate, metric: cpu.meen", NotFound, "did you mean 'cpu.mean'"),
    ],
)
def test_what_does_not_fit_is_one_line(options, error, words):
    with pytest.raises(error, match=words) as refusal:
        build(options)
    assert "\n" not in str(refusal.value)


def test_protocols_are_never_mixed():
    labels = ["SE(3)", "Sim(3)"] * (RUNS // 2)
    fingerprints = ["aaaaaaaaaaaa", "bbbbbbbbbbbb"] * (RUNS // 2)
    with pytest.raises(InvalidInput, match=r"ate.rmse: \d+ runs use SE\(3\).*: not comparable"):
        build("form: line, x: image_rate", protocol=fingerprints, protocol_label=labels)
    mixed = build("form: line, x: image_rate, metric: cpu.mean", protocol=fingerprints, protocol_label=labels)
    assert mixed.protocol is None


@pytest.mark.parametrize("file_format", PRINT_FORMATS)
def test_the_same_chart_gives_the_same_file(file_format: str):
    (chart,) = build("form: line, x: image_rate").charts
    assert len({print_chart(chart, file_format) for _ in range(8)}) == 1


def test_failed_runs_are_drawn_apart_at_their_place():
    (chart,) = build("form: scatter, x: image_rate, y: ate.rmse").charts
    (failed,) = [mark for mark in chart.marks if isinstance(mark, FailedRuns)]
    assert set(failed.x) == {1.0}
    assert len(failed.x) == FAILED
    assert f"n = {RUNS - FAILED} of {RUNS} runs, {FAILED} failed." in chart.caption


def test_the_rule_of_failures_is_one_and_stated():
    strict = build("form: scatter, x: image_rate, y: ate.rmse", rule=FailureRule(ate_rmse_above_m=0.1))
    assert strict.failed > FAILED
    assert "ATE RMSE is above 0.1 m" in strict.charts[0].caption


def test_all_repeats_count():
    (chart,) = build("form: line, x: image_rate, metric: cpu.mean").charts
    line = next(mark for mark in chart.marks if isinstance(mark, Line))
    table = sweep_table().good()
    rows = table[(table["algorithm"] == "kiss-icp") & (table["dataset"] == "kitti_06")]
    expected = rows.groupby("image_rate")["cpu.mean"].mean()
    assert line.x.tolist() == expected.index.tolist()
    assert line.y.tolist() == pytest.approx(expected.tolist())


def test_cells_without_a_good_run_are_empty_and_say_so():
    result = build("form: heatmap, x: image_rate, y: scale")
    chart = next(chart for chart in result.charts if "orb" in chart.title)
    (cells,) = (mark for mark in chart.marks if isinstance(mark, Cells))
    assert np.isnan(cells.values[:, 0]).all()
    assert {text for row in cells.texts for text in row[:1]} == {"6 of 6 failed"}


def test_failure_rates_stand_beside_the_means():
    result = build("form: by_algorithm")
    rates = {mark.name: mark.heights for mark in result.charts[1].marks if isinstance(mark, Bars)}
    assert rates["orb-slam3-stereo"].tolist() == pytest.approx([20.0] * len(DATASETS))
    assert rates["kiss-icp"].tolist() == [0.0] * len(DATASETS)


def test_an_algorithm_is_summed_up_over_its_datasets():
    """Each dataset counts once: mean and spread are those of the means of the datasets, as in the published paper."""
    result = build("form: by_algorithm")
    chart = next(chart for chart in result.charts if chart.key == "over_groups_ate.rmse")
    bars: Any = chart.marks[0]
    assert chart.x.categories == tuple(sorted(ALGORITHMS))
    frame = sweep_table().frame
    means = frame[frame["failed"].isna()].groupby(["algorithm", "dataset"])["ate.rmse"].mean().unstack()
    assert bars.heights == pytest.approx(means.mean(axis=1).to_numpy())
    assert bars.high - bars.heights == pytest.approx(means.std(axis=1).to_numpy())
    assert bars.texts == ("3 groups, 0 % failed", "3 groups, 20 % failed", "3 groups, 0 % failed")
    (table,) = (table for table in result.tables if table.key == "over_groups")
    assert [row[-1] for row in table.rows] == [0.0, 20.0, 0.0]


def test_the_best_configurations_have_settings_and_costs():
    (table,) = (table for table in build("form: by_algorithm").tables if table.key == "best")
    keys = [column.key for column in table.columns]
    rows: list[dict[str, Any]] = [dict(zip(keys, row, strict=True)) for row in table.rows]
    assert {row["settings"].split(",")[0] for row in rows} == {"image_rate 20"}
    assert all(0.2 <= row["cpu.mean"] <= 1.2 and 60 <= row["ram.max"] <= 300 for row in rows)
    (memory,) = (column for column in table.columns if column.key == "ram.max")
    assert memory.heading == "RAM max (mean) [MB]"


def test_failed_runs_float_above_the_others_in_space():
    (chart,) = build("form: scatter_3d, x: image_rate, y: scale, z: ate.rmse").charts
    marks: list[Any] = [mark for mark in chart.marks if isinstance(mark, Points) and mark.z is not None]
    failed = [mark for mark in marks if mark.marker == "failed"]
    assert [mark.name for mark in failed] == ["orb-slam3-stereo, failed"]
    highest = max(float(np.max(mark.z)) for mark in marks if mark.marker != "failed" and len(mark.z))
    assert failed[0].z.tolist() == pytest.approx([1.2 * highest] * len(failed[0].x))
    assert set(failed[0].x) == {1.0}


def test_the_front_is_what_nothing_beats():
    costs = np.array([[1.0, 5.0], [2.0, 3.0], [2.0, 3.0], [3.0, 4.0], [4.0, 1.0], [1.0, 6.0]])
    assert pareto_front(costs).tolist() == [True, True, True, False, True, False]


def test_hostile_names_are_escaped():
    names = ["<img src=x onerror=alert(1)>%{x}"] * RUNS
    result = build("form: scatter, x: image_rate, y: ate.rmse", dataset=names)
    text = json.dumps(plotly_figure(result.charts[0]))
    assert "<img" not in text
    assert b"<img" not in print_chart(result.charts[0], "svg")


@pytest.mark.parametrize("form", PLOT_TYPES)
def test_hostile_names_are_words_in_every_form(form):
    """HTML in hovers, legends and axes; formulas and commands in tables."""
    hostile = {name: f"=<img src=x onerror=alert(1)>%{{x}}{name}" for name in (*ALGORITHMS, *DATASETS)}
    plain = sweep_table().frame
    changed = {key: [hostile[name] for name in plain[key]] for key in ("algorithm", "dataset")}
    result = build(f"form: {form}, {PLOT_TYPES[form]}", **changed)
    drawn = json.dumps([plotly_figure(chart) for chart in result.charts])
    assert "<img" not in drawn
    assert not re.search(r"(?<!\\u200b)%\{x\}(kiss|orb|rko|kitti|room|v101)", drawn)
    for table in result.tables:
        assert not re.search(r"(^|,)\"?=<", table_csv(table), re.MULTILINE)
        assert not re.search(r"(?<!\\)<img", table_markdown(table))
        assert "%{" not in table_latex(table).replace(r"\%\{", "").partition("\n")[2]


def test_where_each_algorithm_breaks():
    result = build("form: sensitivity, x: image_rate, factor: 2.5")
    (table,) = (table for table in result.tables if table.key == "breaking_points")
    broken = {(row[0], row[1]): row[3:5] for row in table.rows}
    assert set(broken.values()) == {(5.0, 2.0)}  # at 2 Hz the error is 2.8 times that at 20 Hz


def test_importance_finds_what_was_put_in():
    result = build("form: importance")
    (table,) = (table for table in result.tables if table.key == "importance")
    accuracy = {row[0]: float(row[1] or 0) for row in table.rows}
    assert accuracy["image_rate"] > 30
    assert accuracy["algorithm"] > 20
    assert accuracy["scale"] < 1
    failing = {row[0]: float(row[2] or 0) for row in table.rows}
    assert failing["algorithm with image_rate"] > 30


@pytest.mark.parametrize("axes", ["x: dataset, y: algorithm", "x: algorithm, y: dataset", "x: dataset, y: image_rate"])
def test_a_heat_map_over_datasets_and_algorithms_can_be_exported(axes):
    result = build(f"form: heatmap, {axes}")
    for table in result.tables:
        assert table_parquet(table)
        assert table_csv(table)
    assert len(result.charts) == (1 if "algorithm" in axes else len(ALGORITHMS))


def test_a_table_cannot_have_one_column_twice():
    column = TableColumn("algorithm", "Algorithm")
    with pytest.raises(ValueError, match="two columns of one key"):
        ResultTable("t", "t", (column, column), ())


def test_datasets_that_no_number_of_repeats_decides_are_named():
    table = sweep_table()
    same = table.frame["ate.rmse"].mask(table.frame["dataset"] == "room", table.frame["scale"])
    tied = table.with_rows(table.frame.assign(**{"ate.rmse": same, FAILED_COLUMN: None}))
    analysis = parse_analysis("name: t\nselect: {a: {runs: [1]}}\nforms:\n- {form: critical_difference}\n")
    result = analysis.plots[0].plot_type.build(data_of(tied), analysis.plots[0].options)
    (pairs,) = (entry for entry in result.tables if entry.key == "pairs")
    assert {row[8] for row in pairs.rows} == {"room"}


def test_failed_runs_never_count_as_accurate():
    result = build("form: coverage")
    (table,) = (table for table in result.tables if table.key == "coverage")
    shares = {row[0]: row[3:] for row in table.rows}
    assert shares["orb-slam3-stereo"][-1] is None  # a fifth of its runs failed: no bound keeps 90 %
    assert shares["kiss-icp"][-1] is not None


def test_the_selector_ranks_what_keeps_all_bounds():
    result = build('form: selector, bounds: ["ate.rmse < 0.06"]')
    ranking, reasons, untested, _ = result.tables
    assert [row[1] for row in ranking.rows][:1] == ["kiss-icp"]
    assert "image_rate 20" in str(ranking.rows[0][2])
    assert untested.rows == ()
    assert {row[0]: row[3] for row in reasons.rows}["orb-slam3-stereo"] == 0


def test_installed_algorithms_without_runs_were_never_tested():
    installed = {"kiss-icp": "lidar", "new-lidar": "lidar", "new-mono": "mono"}
    table = replace(sweep_table(), installed=installed)
    analysis = parse_analysis(
        "name: t\nselect: {a: {runs: [1]}}\nforms:\n- {form: selector, bounds: ['ate.rmse < 1']}\n"
    )
    result = analysis.plots[0].plot_type.build(data_of(table), analysis.plots[0].options)
    (untested,) = (entry for entry in result.tables if entry.key == "untested")
    assert untested.rows == tuple(("new-lidar", dataset) for dataset in DATASETS)


def test_repeats_of_one_configuration():
    with pytest.raises(InvalidInput, match="needs one configuration_id, the selection has 180"):
        build("form: repeatability")
    result = build("form: repeatability", configuration_id=[7] * RUNS)
    assert "95 % bootstrap interval" in result.charts[0].caption


@pytest.mark.parametrize(
    "form", ["line", "scatter", "distributions", "coverage", "importance", "parallel", "sensitivity"]
)
def test_no_figure_without_a_point(form):
    with pytest.raises(InvalidInput, match="all 360 runs count as failed; loosen 'failed_when'"):
        build(f"form: {form}, {PLOT_TYPES[form]}", rule=FailureRule(ate_rmse_above_m=1e-9))


def test_parameters_that_only_one_algorithm_has_do_not_vary():
    table = sweep_table()
    own = np.where(table.frame["algorithm"] == "kiss-icp", 3.0, np.nan)
    column = Column("own", "own", ColumnKind.PARAMETER)
    widened = replace(table, frame=table.frame.assign(own=own), columns={**table.columns, "own": column})
    assert [entry.key for entry in widened.varied()] == ["image_rate", "scale"]


def test_installed_algorithms_keep_their_colours():
    installed = [f"{letter}-slam" for letter in "abcdefgh"]
    alone = algorithm_colours(["c-slam"], installed)["c-slam"]
    assert alone == PALETTE[2] == algorithm_colours(["b-slam", "c-slam", "z-slam"], installed)["c-slam"]
    many = algorithm_colours([f"other-{place}" for place in range(10)], installed)
    assert len(set(many.values())) == 10


def test_the_legend_names_algorithms_and_datasets_not_each_pair():
    (chart,) = build("form: scatter, x: image_rate, y: ate.rmse").charts
    named = [mark.name for mark in chart.marks if isinstance(mark, Points) and mark.in_legend]
    assert named == [*sorted(ALGORITHMS), *(f"on {name}" for name in sorted(DATASETS))]
    assert chart.legend_entries == len(named)


def test_markers_that_cannot_be_told_apart_mean_nothing():
    names = [f"sequence_{place % 9}" for place in range(RUNS)]
    (flat,) = build("form: scatter, x: image_rate, y: ate.rmse", dataset=names).charts
    (space,) = build("form: scatter_3d, x: image_rate, y: scale, z: ate.rmse", dataset=names).charts
    assert flat.legend_entries == 3 + 9
    assert space.legend_entries == 3
    assert {mark.marker for mark in space.marks if isinstance(mark, Points)} == {"circle", "failed"}


def test_maps_of_several_algorithms_share_their_colours():
    charts = build("form: heatmap, x: image_rate, y: scale").charts
    cells = [mark for chart in charts for mark in chart.marks if isinstance(mark, Cells)]
    assert len({entry.span for entry in cells}) == 1
    low, high = cells[0].span or (0.0, 0.0)
    values = np.concatenate([entry.values.ravel() for entry in cells])
    assert (low, high) == (np.nanmin(values), np.nanmax(values))


def test_what_cannot_be_told_is_no_zero():
    table = sweep_table()
    one = table.with_rows(table.frame.drop_duplicates("configuration_id"))
    once = one.with_rows(one.frame[(one.frame["algorithm"] == "kiss-icp") & (one.frame["dataset"] == "room")])
    analysis = parse_analysis(
        "name: t\nselect: {a: {runs: [1]}}\nforms:\n- {form: importance, parameters: [image_rate, scale]}\n"
    )
    result = analysis.plots[0].plot_type.build(data_of(once), analysis.plots[0].options)
    rows = {row[0]: row[1] for row in result.tables[0].rows}
    assert rows["image_rate with scale"] is None
    assert float(rows["image_rate"] or 0) > 90


def test_settings_compete_over_datasets():
    result = build("form: critical_difference, of: settings, metric: cpu.mean")
    (pairs,) = (table for table in result.tables if table.key == "pairs")
    names = {row[0] for row in pairs.rows} | {row[1] for row in pairs.rows}
    assert len(names) == len(ALGORITHMS) * len(RATES) * len(SCALES)
    assert "kiss-icp, image_rate 20, scale 0.5" in names
    for row in pairs.rows:
        assert sum(int(cell or 0) for cell in row[4:7]) in {0, len(DATASETS)}


def test_a_pair_counts_the_datasets_that_both_were_run_on():
    table = sweep_table()
    frame = table.frame
    without = frame[~((frame["algorithm"] == "rko-lio") & (frame["dataset"] == "v101"))]
    analysis = parse_analysis("name: t\nselect: {a: {runs: [1]}}\nforms:\n- {form: critical_difference}\n")
    result = analysis.plots[0].plot_type.build(data_of(table.with_rows(without)), analysis.plots[0].options)
    (pairs,) = (entry for entry in result.tables if entry.key == "pairs")
    compared = {(row[0], row[1]): sum(int(cell or 0) for cell in row[4:7]) for row in pairs.rows}
    assert compared["kiss-icp", "rko-lio"] == 2
    assert compared["kiss-icp", "orb-slam3-stereo"] == 3


def test_a_form_that_needs_one_dataset_says_so():
    with pytest.raises(InvalidInput, match="needs one dataset, the selection has 3: kitti_06, room, v101"):
        build("form: trajectories")
    with pytest.raises(InvalidInput, match="no selected run has sampled usage"):
        build("form: usage")
    with pytest.raises(InvalidInput, match="evaluated under 0 protocol"):
        build("form: protocols")


class TracksWithAPause(NoFiles):
    """Every run has four poses, with a pause in the middle."""

    def track(self, run_id: int) -> RunTrack | None:
        stamps_s = np.array([0.0, 0.1, 5.0, 5.1])
        positions_m = np.stack([stamps_s, stamps_s**2, 0 * stamps_s], axis=1)
        errors_m = np.array([0.1, 0.1, np.nan, 0.2])
        return RunTrack(run_id, stamps_s, positions_m, errors_m, np.array([0, 0, 1, 1]), stamps_s, positions_m)


def test_no_line_is_drawn_over_a_pause():
    table = sweep_table()
    one = table.with_rows(table.frame[table.frame["dataset"] == "room"].head(3))
    analysis = parse_analysis("name: t\nselect: {a: {runs: [1]}}\nforms:\n- {form: trajectories}\n")
    data = replace(data_of(one), files=TracksWithAPause())
    result = analysis.plots[0].plot_type.build(data, analysis.plots[0].options)
    for chart in result.charts:
        estimates = [mark for mark in chart.marks if isinstance(mark, Line) and mark.runs]
        assert len(estimates) == 3
        assert all(np.isnan(mark.x[2]) and np.isnan(mark.y[2]) for mark in estimates)
        assert "Lines break where the estimate has a longer gap" in chart.caption
    (poses,) = (entry for entry in result.tables if entry.key == "poses")
    assert len(poses.rows) == 12


class TracksOfTwoSensors(NoFiles):
    """Estimates of two frames, 0.11 m apart; each equals the ground truth in its own frame."""

    def __init__(self, lidar_runs: set[int]) -> None:
        self.lidar_runs = lidar_runs

    def track(self, run_id: int) -> RunTrack | None:
        timestamps_s = np.arange(5.0)
        positions_m = np.stack([timestamps_s, timestamps_s**2, 0 * timestamps_s], axis=1)
        positions_m[:, 0] += 0.11 if run_id in self.lidar_runs else 0.0
        return RunTrack(
            run_id, timestamps_s, positions_m, 0 * timestamps_s, 0 * timestamps_s, timestamps_s, positions_m
        )


def test_every_run_is_drawn_with_the_ground_truth_of_its_own_sensor():
    table = sweep_table()
    room = table.frame[(table.frame["dataset"] == "room") & (table.frame["image_rate"] == 20)]
    chosen = table.with_rows(room.groupby("algorithm").head(2))
    lidar_runs = set(room[room["algorithm"] == "rko-lio"]["run_id"])
    analysis = parse_analysis("name: t\nselect: {a: {runs: [1]}}\nforms:\n- {form: trajectories}\n")
    data = replace(data_of(chosen), files=TracksOfTwoSensors(lidar_runs))
    result = analysis.plots[0].plot_type.build(data, analysis.plots[0].options)
    for chart in result.charts[:4]:
        truths = {mark.name: mark for mark in chart.marks if isinstance(mark, Line) and mark.dashed}
        assert set(truths) == {"ground truth for kiss-icp, orb-slam3-stereo", "ground truth for rko-lio"}
        for mark in chart.marks:
            if isinstance(mark, Line) and mark.runs:
                own = truths["ground truth for rko-lio" if mark.runs in lidar_runs else min(truths)]
                assert np.array_equal(mark.x, own.x)
                assert np.array_equal(mark.y, own.y)
        assert "follow 2 different sensors" in chart.caption
        assert len({mark.colour for mark in truths.values()}) == 2


def test_a_parameter_of_one_algorithm_counts_within_it():
    table = sweep_table()
    draws = np.random.default_rng(2)
    own = np.where(table.frame["algorithm"] == "kiss-icp", draws.integers(0, 3, RUNS).astype(float), np.nan)
    values = table.frame["algorithm"].map({"kiss-icp": 1.0, "orb-slam3-stereo": 4.0, "rko-lio": 9.0}) + np.nan_to_num(
        own
    )
    columns = {**table.columns, "own": Column("own", "own", ColumnKind.PARAMETER)}
    frame = table.frame.assign(own=own, **{"ate.rmse": values, FAILED_COLUMN: None})
    analysis = parse_analysis(
        "name: t\nselect: {a: {runs: [1]}}\nforms:\n- {form: importance, parameters: [algorithm, own]}\n"
    )
    result = analysis.plots[0].plot_type.build(
        data_of(replace(table, frame=frame, columns=columns)), analysis.plots[0].options
    )
    shares = {row[0]: row[1] for row in result.tables[0].rows}
    assert set(shares) == {"algorithm", "own"}
    assert sum(float(share or 0) for share in shares.values()) == pytest.approx(100, abs=0.01)
