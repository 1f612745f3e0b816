"""A comparison of runs, for its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slamhive.analysis.chart import RUN_COLOURS, Chart, Line
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.analysis.report import Plot
from slamhive.documents.protocol import ComparedValue
from slamhive.domain.metrics import Direction, Group, Metric
from slamhive.domain.names import plural
from slamhive.domain.verdict import Outcome
from slamhive.services.run_comparison import RunColumn, RunComparison
from slamhive.services.run_differences import differences, from_start
from slamhive.services.runs import RunSeries, RunService
from slamhive.web.figures import ComparedRun, best_plane, compared_figures, timeline
from slamhive.web.formatting import DASH, DisplayUnit, TableCell, display_unit, significant

_PLACES = {
    "trajectories_xy": "path_xy",
    "trajectories_xz": "path_xz",
    "trajectories_yz": "path_yz",
    "trajectory_error": "error",
    "usage_cpu": "cpu",
    "usage_memory": "memory",
    "latency": "latency",
}
"""{key of a plot: its place on the page}; other plots of the analysis are not shown."""
_OVER_TIME = ("error", "cpu", "memory", "latency")
_PLACES_OF_FORM = {
    "trajectories": ("path", "error"),
    "usage": ("cpu", "memory"),
    "latency": ("latency",),
}
_PARAMETER = "parameter."
_BETTER = {Direction.LOWER: "lower is better", Direction.HIGHER: "higher is better"}


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


@dataclass(frozen=True, slots=True)
class Told:
    """A sentence about a run, and the time of the recording in s that it is about, None for all of it."""

    run: int
    words: str
    peak_s: float | None


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
    found: dict[str, list[ComparedMetric]] = {}
    for name, lines in groups.items():
        for line in lines:
            metric, unit = line.metric, display_unit(line.metric)
            cells = tuple(_metric_cell(figure, unit, metric) for figure in line.figures)
            row = ComparedMetric(metric, unit.unit, _BETTER.get(metric.direction, ""), cells, line.best)
            found.setdefault(name, []).append(row)
    return found


HEADLINES = (
    *("ate.rmse", "rpe.rmse", "ate_rot.rmse", "tracked_fraction", "frames.dropped_fraction", "latency.p95"),
    *("deadline.missed_fraction", "cpu.mean", "ram.max", "duration"),
)
"""Metrics that the table of differences shows; the table of all metrics has the others."""


def differing_metrics(compared: RunComparison) -> list[ComparedMetric]:
    """The main metrics in which the columns differ, as differences to the baseline with the value below each."""
    rows = []
    known = {line.metric.key: line for line in compared.metrics}
    for line in (known[key] for key in HEADLINES if key in known and known[key].differs):
        unit, base = display_unit(line.metric), line.figures[compared.baseline]
        cells = []
        for place, figure in enumerate(line.figures):
            cell = _metric_cell(figure, unit, line.metric)
            if place != compared.baseline and figure is not None and base is not None:
                change = (figure.mean - base.mean) * unit.factor
                same = figure.shown == base.shown
                text = "same" if same else f"{'+' if change > 0 else '−'}{significant(abs(change))}"
                note = f"{cell.text} {f'({cell.note})' if cell.note else ''}".strip()
                cell = TableCell(text, cell.exact, note=note)
            cells.append(cell)
        better = _BETTER.get(line.metric.direction, "")
        rows.append(ComparedMetric(line.metric, unit.unit, better, tuple(cells), line.best))
    return rows


def address_args(compared: RunComparison) -> dict[str, str]:
    """The arguments of the permanent address, without the protocol and the baseline."""
    runs = ",".join(str(run.id) for run in compared.runs)
    return {"runs": runs} | ({"group": "configuration"} if compared.grouped else {})


def series_of(compared: RunComparison, runs: RunService) -> list[tuple[int, RunSeries]]:
    """Each run with what is known of it over time under the common protocol, all on the clock of the baseline.

    Runs of another dataset than the baseline are left out: their moments are others.
    """
    base = compared.columns[compared.baseline].runs[0]
    fingerprint = None if compared.protocol is None else compared.protocol.fingerprint
    read = {run.id: runs.series(run.id, fingerprint) for run in compared.runs if run.dataset == base.dataset}
    start_s = read[base.id].start_s
    return [(run, series if start_s is None else from_start(series, start_s)) for run, series in read.items()]


def story(compared: RunComparison, series: Sequence[tuple[int, RunSeries]]) -> list[Told]:
    """Where each run differs from the baseline the most, the largest error first; empty for grouped repeats."""
    if compared.grouped or compared.protocol is None:
        return []
    base = compared.columns[compared.baseline].runs[0].id
    having = {run: data for run, data in series if run in compared.protocol.runs}
    if base not in having:
        return []
    others = [(run, data) for run, data in having.items() if run != base]
    found = differences((base, having[base]), others)
    subjects = [(entry.other if entry.run == base else entry.run, entry) for entry in found]
    told = [Told(run, entry.words(run), entry.peak_s) for run, entry in subjects]
    same = [run for run, _ in others if run not in {entry.run for entry in told}]
    return [*told, *(Told(run, f"Run {run} is as good as run {base} all the time.", None) for run in same)]


def single_figures(compared: RunComparison, series: Sequence[tuple[int, RunSeries]]) -> dict[str, Any]:
    """The plots of single runs by place on the page, with captions, reasons for missing ones, and their moments."""
    colours = {head.column.runs[0].id: head.colour for head in heads(compared)}
    names = {run.id: f"run {run.id}, {run.algorithm}" for run in compared.runs}
    shown = [ComparedRun(run, names[run], colours[run], data) for run, data in series]
    drawn = compared_figures(shown)
    told = story(compared, series)
    label = "" if compared.protocol is None else compared.protocol.label
    without = sorted({run.id for run in compared.runs} - {run for run, _ in series})
    elsewhere = f" Not shown, because of another dataset: {runs_words(without)}." if without else ""
    lacking = [run for run, data in series if data.error is None]
    unjudged = f" Not shown, because not evaluated under this protocol: {runs_words(lacking)}." if lacking else ""
    track = next((data.groundtruth or data.estimate for _, data in series if data.aligned), None)

    # The time that the plots share; its worst moment is where two runs differ the most.
    shared: dict[str, Any] | None = None
    known = [entry for _, data in series if (entry := timeline(data)) is not None]
    if known:
        origin_s = known[0]["origin_s"]
        peak_s = next((entry.peak_s for entry in told if entry.peak_s), None)
        worst = [entry["worst_s"] for entry in known if entry["worst_s"] is not None]
        shared = {
            "origins": {key: origin_s for entry in known for key in entry["origins"]},
            "origin_s": origin_s,
            "from_s": min(entry["from_s"] for entry in known),
            "until_s": max(entry["until_s"] for entry in known),
            "worst_s": origin_s + peak_s if peak_s is not None else next(iter(worst), None),
        }

    return {
        "figures": drawn,
        "captions": {
            "path": f"Aligned with {label}. Ground truth dashed.{unjudged}{elsewhere}",
            "error": f"Distance from the estimate to the ground truth; {label}.{unjudged}{elsewhere}",
            "latency": f"From arrival to result; crosses are dropped frames.{elsewhere}",
            "dropped": f"Frames that the algorithm was too slow to take.{elsewhere}",
            "cpu": f"Cores summed, player included.{elsewhere}",
            "memory": f"Player included.{elsewhere}",
        },
        "reasons": {
            "estimate": _UNJUDGED,
            "error": _UNJUDGED,
            "dropped": "No frame was dropped.",
            **dict.fromkeys(("latency", "cpu", "memory"), "these runs have no data for this plot"),
        },
        "timeline": shared,
        "best_plane": "xy" if track is None else best_plane(track),
    }


_UNJUDGED = "No run here has been evaluated under a common protocol."


def runs_words(runs: Sequence[int]) -> str:
    """``run 3``, or ``runs 3, 5``."""
    return f"{'run' if len(runs) == 1 else 'runs'} {', '.join(map(str, runs))}"


def grouped_figures(plots: Sequence[Plot]) -> dict[str, Any]:
    """The same for repeats that are folded into mean and band, as an analysis draws them."""
    charts = {_PLACES[chart.key]: chart for plot in plots for chart in plot.charts if chart.key in _PLACES}
    drawn = {place: _figure(chart) for place, chart in charts.items()}
    for axis in {charts[place].x for place in _OVER_TIME if place in charts}:
        places = [place for place in _OVER_TIME if place in charts and charts[place].x == axis]
        spans = [span for place in places if (span := _span(charts[place])) is not None]
        for place in places if spans else ():
            drawn[place]["layout"]["xaxis"]["range"] = [min(low for low, _ in spans), max(high for _, high in spans)]
    filled = {place: plot for plot in plots for place in _PLACES_OF_FORM.get(plot.form, ())}
    plane = next((place.removeprefix("path_") for place in charts if place.startswith("path_")), "xy")
    captions = {"path" if place.startswith("path_") else place: chart.caption for place, chart in charts.items()}
    reasons = {place: _reason(plot) for place, plot in filled.items() if place not in captions}
    return {
        "figures": drawn,
        "captions": {place: " ".join([text, *filled[place].exclusions]) for place, text in captions.items()},
        "reasons": {"estimate" if place == "path" else place: text for place, text in reasons.items()},
        "timeline": None,
        "best_plane": plane,
    }


def _reason(plot: Plot) -> str:
    """Why there is no plot, without the place in the analysis file, which the page does not show."""
    text = plot.error or "these runs have no data for this plot"
    return text.partition(": ")[2] or text


def _figure(chart: Chart) -> dict[str, Any]:
    """The plot without a height of its own, which the page decides. The chips of the page name the lines."""
    figure = plotly_figure(chart)
    figure["layout"].pop("height", None)
    figure["layout"]["showlegend"] = False
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
    run = column.runs[0]
    if run.outcome is not Outcome.GOOD:
        return run.outcome_words
    return "failed" if column.failed else ""  # under the chosen protocol alone


def _metric_cell(figure: ComparedValue | None, unit: DisplayUnit, metric: Metric) -> TableCell:
    if figure is None:
        return TableCell(DASH, f"no {metric.label} known", missing=True)
    text, exact = significant(figure.mean * unit.factor), f"{figure.mean!r} {metric.unit}".strip()
    if figure.low is None or figure.high is None:
        return TableCell(text, exact)
    ends = f"{significant(figure.low * unit.factor)} to {significant(figure.high * unit.factor)}"
    return TableCell(text, f"mean of {figure.count}: {exact}", note=ends)
