"""Runs that were measured on a disturbed machine, in tables and charts: counted, ringed, told on hover."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slamhive.analysis.chart import Chart, Points, thinned
from slamhive.analysis.plot_types import PLOT_TYPES
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.analysis.print_chart import print_chart
from slamhive.analysis.report import PlotResult
from slamhive.analysis.table import UNDISTURBED, RunTable
from tests.analysis.analysis_world import data_of, sweep_table

pytestmark = pytest.mark.integration  # plotting and statistics take seconds to load

COUNT = len(sweep_table().frame)
BUSY = "load of others, steal"


def some_disturbed(every: int = 10) -> RunTable:
    """Every tenth run was disturbed, of every tenth it is not known."""
    words = [BUSY if place % every == 0 else None if place % every == 1 else UNDISTURBED for place in range(COUNT)]
    return sweep_table(disturbed=list(words))


def build(table: RunTable, form: str, **options: object) -> PlotResult:
    chosen = PLOT_TYPES.get(form)
    return chosen.build(data_of(table), chosen.options(**options))


def rings(chart: Chart) -> list[Points]:
    return [mark for mark in chart.marks if isinstance(mark, Points) and mark.ring]


def test_captions_count_disturbed_runs() -> None:
    table = some_disturbed()
    (chart,) = build(table, "scatter", x="image_rate", y="ate.rmse").charts
    assert f"{COUNT // 10} of {COUNT} runs measured on a disturbed machine." in chart.caption
    (quiet,) = build(sweep_table(), "scatter", x="image_rate", y="ate.rmse").charts
    assert "disturbed" not in quiet.caption
    (without,) = build(replace(sweep_table(), without_disturbed=7), "scatter", x="image_rate", y="ate.rmse").charts
    assert "7 runs measured on a disturbed machine left out." in without.caption


@pytest.mark.parametrize(
    ("form", "options"),
    [
        ("scatter", {"x": "image_rate", "y": "ate.rmse"}),
        ("scatter_3d", {"x": "image_rate", "y": "cpu.mean", "z": "ate.rmse"}),
    ],
)
def test_their_points_have_rings(form: str, options: dict[str, str]) -> None:
    table = some_disturbed()
    (chart,) = build(table, form, **options).charts
    (ring,) = rings(chart)
    assert ring.runs is not None
    good = set(table.good()["run_id"])
    assert set(ring.runs) == {run for run in table.disturbed()["run_id"] if run in good}
    points = {
        int(run): (x, y)
        for mark in chart.marks
        if isinstance(mark, Points) and not mark.ring and mark.runs is not None
        for run, x, y in zip(mark.runs, mark.x, mark.y, strict=True)
    }
    assert [points[int(run)] for run in ring.runs] == list(zip(ring.x, ring.y, strict=True))
    assert ring.texts == (f"disturbed by {BUSY}",) * len(ring.x)
    trace = next(trace for trace in plotly_figure(chart)["data"] if trace["name"] == "disturbed machine")
    assert trace["marker"]["symbol"] == "circle-open"
    assert trace["showlegend"]
    assert print_chart(chart, "svg").startswith(b"<?xml")


def test_without_disturbed_runs_there_is_no_ring() -> None:
    (chart,) = build(sweep_table(), "scatter", x="image_rate", y="ate.rmse").charts
    assert rings(chart) == []


def test_rings_do_not_count_where_the_density_is_drawn() -> None:
    places = np.linspace(0.0, 1.0, 10_000)
    (chart,) = build(some_disturbed(), "scatter", x="image_rate", y="ate.rmse").charts
    many = Points("many", places, places)
    few = thinned(replace(chart, marks=(many, *rings(chart))))
    assert rings(few) == rings(chart), "10,000 points and their rings are drawn one by one"


def test_repeats_are_ringed_too() -> None:
    table = some_disturbed(every=2)
    one = table.with_rows(table.frame[table.frame["configuration_id"] == 3])
    (chart,) = build(one, "repeatability").charts
    (ring,) = rings(chart)
    assert ring.runs is not None
    assert set(ring.runs) == set(one.disturbed()["run_id"])


def test_tables_count_and_name_them() -> None:
    table = some_disturbed()
    (raw,) = build(table, "scatter", x="image_rate", y="ate.rmse").tables
    place = [column.key for column in raw.columns].index("disturbed")
    assert [row[place] for row in raw.rows[:3]] == [BUSY, None, UNDISTURBED]
    one = table.with_rows(table.frame[table.frame["configuration_id"] == 1])
    summary = build(one, "repeatability").tables[0]
    keys = [column.key for column in summary.columns]
    assert [row[keys.index("disturbed")] for row in summary.rows] == [1]
