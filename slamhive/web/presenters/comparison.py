"""A comparison of runs, for its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slamhive.analysis.chart import RUN_COLOURS, Chart, Line
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.analysis.report import Plot
from slamhive.domain.metrics import Direction, Group, Metric
from slamhive.domain.names import plural
from slamhive.services.run_comparison import Figure, RunColumn, RunComparison
from slamhive.web.formatting import DASH, DisplayUnit, TableCell, display_unit, significant

_PLACES = {
    "trajectories_xy": "path_2d",
    "trajectories_xz": "path_2d",
    "trajectories_yz": "path_2d",
    "trajectory_error": "error",
    "usage_cpu": "cpu",
    "usage_memory": "memory",
    "latency": "latency",
}
"""{key of a plot: its place on the page}; other plots of the analysis are not shown."""
_OVER_TIME = ("error", "cpu", "memory", "latency")
_PLACES_OF_FORM = {
    "trajectories": ("path_2d", "error"),
    "usage": ("cpu", "memory"),
    "latency": ("latency",),
}
_PARAMETER = "parameter."


@dataclass(frozen=True, slots=True)
class Head:
    """The head of a column: a run, or a configuration with its runs."""

    column: RunColumn
    colour: str
    note: str


@dataclass(frozen=True, slots=True)
class SettingRow:
    """One setting: its name, whether it is a parameter, a cell for each column."""

    name: str
    is_parameter: bool
    differs: bool
    cells: tuple[TableCell, ...]


@dataclass(frozen=True, slots=True)
class ComparedMetric:
    """One metric: a cell for each column; ``best`` is the column to mark."""

    metric: Metric
    unit: str
    better: str
    cells: tuple[TableCell, ...]
    best: int | None


def heads(compared: RunComparison) -> list[Head]:
    """The heads, with the colours that the plots use."""
    return [
        Head(column, RUN_COLOURS[place % len(RUN_COLOURS)], _note(column, grouped=compared.grouped))
        for place, column in enumerate(compared.columns)
    ]


def setting_rows(compared: RunComparison) -> list[SettingRow]:
    """All settings; those that differ come first."""
    rows = []
    for line in compared.settings:
        cells = tuple(
            TableCell(DASH, "not stated", missing=True) if text is None else TableCell(text) for text in line.texts
        )
        name = line.key.removeprefix(_PARAMETER)
        rows.append(SettingRow(name, line.key.startswith(_PARAMETER), line.differs, cells))
    return sorted(rows, key=lambda row: not row.differs)


def metric_groups(compared: RunComparison) -> dict[str, list[ComparedMetric]]:
    """The metrics by group, in the order of the catalogue; those that were measured during the run come last."""
    accuracy = [line for line in compared.metrics if line.metric.needs_protocol]
    groups = {group.value: [line for line in accuracy if line.metric.group is group] for group in Group}
    groups["measured during the run"] = [line for line in compared.metrics if not line.metric.needs_protocol]
    better = {Direction.LOWER: "lower is better", Direction.HIGHER: "higher is better"}
    found: dict[str, list[ComparedMetric]] = {}
    for name, lines in groups.items():
        for line in lines:
            metric, unit = line.metric, display_unit(line.metric)
            cells = tuple(_metric_cell(figure, unit, metric) for figure in line.figures)
            row = ComparedMetric(metric, unit.unit, better.get(metric.direction, ""), cells, line.best)
            found.setdefault(name, []).append(row)
    return found


def address_args(compared: RunComparison) -> dict[str, str]:
    """The arguments of the permanent address, without the protocol."""
    runs = ",".join(str(run.id) for run in compared.runs)
    return {"runs": runs} | ({"group": "configuration"} if compared.grouped else {})


def figures(plots: Sequence[Plot]) -> dict[str, Any]:
    """``figures``, ``captions`` and ``reasons`` by place on the page; plots over the same time share their range."""
    charts = {_PLACES[chart.key]: chart for plot in plots for chart in plot.charts if chart.key in _PLACES}
    drawn = {place: _figure(chart) for place, chart in charts.items()}
    for axis in {charts[place].x for place in _OVER_TIME if place in charts}:
        places = [place for place in _OVER_TIME if place in charts and charts[place].x == axis]
        spans = [span for place in places if (span := _span(charts[place])) is not None]
        for place in places if spans else ():
            drawn[place]["layout"]["xaxis"]["range"] = [min(low for low, _ in spans), max(high for _, high in spans)]
    filled = {place: plot for plot in plots for place in _PLACES_OF_FORM.get(plot.form, ())}
    return {
        "figures": drawn,
        "captions": {place: " ".join([chart.caption, *filled[place].exclusions]) for place, chart in charts.items()},
        "reasons": {place: _reason(plot) for place, plot in filled.items() if place not in drawn},
        "best_plane": "xy",
    }


def _reason(plot: Plot) -> str:
    """Why there is no plot, without the place in the analysis file, which the page does not show."""
    text = plot.error or "these runs have no data for this plot"
    return text.partition(": ")[2] or text


def _figure(chart: Chart) -> dict[str, Any]:
    """The plot without a height of its own, which the page decides. One legend is enough for all plots."""
    figure = plotly_figure(chart)
    figure["layout"].pop("height", None)
    figure["layout"]["showlegend"] = _PLACES[chart.key] == "path_2d"
    return figure


def _span(chart: Chart) -> tuple[float, float] | None:
    """The smallest and largest time of the lines of a plot, in s."""
    times_s = [mark.x for mark in chart.marks if isinstance(mark, Line) and np.isfinite(mark.x).any()]
    if not times_s:
        return None
    return min(float(np.nanmin(times)) for times in times_s), max(float(np.nanmax(times)) for times in times_s)


def _note(column: RunColumn, *, grouped: bool) -> str:
    if grouped:
        counts = {"failed": len(column.failed), "doubtful": len(column.doubtful)}
        return ", ".join(
            [plural(len(column.runs), "run"), *(f"{count} {word}" for word, count in counts.items() if count)]
        )
    return "failed" if column.failed else ""


def _metric_cell(figure: Figure | None, unit: DisplayUnit, metric: Metric) -> TableCell:
    if figure is None:
        return TableCell(DASH, f"no {metric.label} known", missing=True)
    text, exact = significant(figure.mean * unit.factor), f"{figure.mean!r} {metric.unit}".strip()
    if figure.low is None or figure.high is None:
        return TableCell(text, exact)
    ends = f"{significant(figure.low * unit.factor, 3)} to {significant(figure.high * unit.factor, 3)}"
    return TableCell(text, f"mean of {figure.count}: {exact}", note=ends)
