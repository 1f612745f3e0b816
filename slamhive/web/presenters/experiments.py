"""Experiments for tables and pages: progress, the grid over two axes, results by configuration."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from slamhive.documents.experiment import ExperimentPreviewDocument
from slamhive.documents.plain import ExperimentStatusDocument
from slamhive.domain.metrics import Metric
from slamhive.domain.parameters import Value
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import Failure, Outcome, failure_words
from slamhive.filters.words import matching
from slamhive.services.experiments import (
    NO_FIGURES,
    Cell,
    CellFigures,
    ExperimentGrid,
    GridCell,
    MetricGrid,
    MetricSpread,
)
from slamhive.services.hive import Hive
from slamhive.services.run_comparison import MOST_RUNS
from slamhive.services.runs import RunProgress
from slamhive.store.records import RunRecord, RunSort
from slamhive.web.formatting import (
    DASH,
    TableCell,
    display_unit,
    duration,
    mean_text,
    median_text,
    plural,
    size,
    thousands,
    value_text,
)
from slamhive.web.small_plots import levels

MOST_COMPARED = MOST_RUNS // 2
JUDGED = (RunState.SUCCEEDED, RunState.FAILED)
MOST_ROWS, MOST_COLUMNS = 50, 25
"""Limits of the grid on a page."""

Search = Callable[[Mapping[str, Value | None], Sequence[int]], dict[str, str] | None]
"""Arguments of the runs page for a place in the grid, from its axis values and configuration numbers."""
_DRAWN = (*(outcome for outcome in Outcome if outcome.ended), Outcome.RUNNING, Outcome.QUEUED)


@dataclass(frozen=True, slots=True)
class Segment:
    """A segment of a progress bar that is 100 wide."""

    outcome: Outcome
    start: float
    width: float


@dataclass(frozen=True, slots=True)
class GridEntry:
    """One place in the grid.

    ``number``: the cell, if there is exactly one. ``search``: arguments of the runs page for several cells, or None.
    ``value`` is the mean of the metric that the grid shows, if it shows one.
    """

    total: int
    ended: int
    segments: tuple[Segment, ...]
    notes: tuple[str, ...]
    explanation: str
    number: int | None
    search: Mapping[str, str] | None
    value: TableCell | None = None


@dataclass(frozen=True, slots=True)
class GridView:
    """The grid with its headings. ``lines`` contain None for missing combinations; ``left_out`` is what it omits.

    ``metric`` is None for the progress. ``notes`` say what the means of a metric contain.
    """

    row_axis: str
    column_axis: str
    columns: tuple[str, ...]
    lines: tuple[tuple[str, tuple[GridEntry | None, ...]], ...]
    left_out: str
    metric: Metric | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class CellLine:
    """One line of the results: a cell under one protocol. A cell without metrics also has one line.

    ``title`` is its name without that of the experiment; ``selects`` are the runs that its box selects.
    """

    cell: Cell
    first: bool
    title: str
    selects: str
    values: tuple[str, ...]
    progress: str
    failures: str
    protocol: str
    evaluated: bool
    figures: tuple[TableCell, ...]


def segments(counts: Mapping[Outcome, int]) -> tuple[Segment, ...]:
    """The segments of a bar: finished runs first. Queued runs leave it empty, so a bar that begins is not full."""
    total = sum(counts.values())
    found: list[Segment] = []
    start = 0.0
    for outcome in _DRAWN:
        if outcome is not Outcome.QUEUED and (count := counts.get(outcome, 0)):
            width = 100 * count / total
            found.append(Segment(outcome, round(start, 3), round(width, 3)))
            start += width
    return tuple(found)


def counts_in_words(counts: Mapping[Outcome, int]) -> str:
    """``3 good, 1 failed, 2 queued``."""
    return ", ".join(f"{thousands(counts[entry])} {entry.label}" for entry in _DRAWN if counts.get(entry)) or "no runs"


def failures_in_words(failures: Mapping[Failure, int]) -> str:
    """``2 nonzero exit, 1 diverged``, most frequent first; lost runs are no failures."""
    reasons = [entry for entry in failures.items() if entry[0] is not FailureReason.LOST]
    ordered = sorted(reasons, key=lambda entry: (-entry[1], entry[0].value))
    return ", ".join(f"{thousands(count)} {failure_words(failure)}" for failure, count in ordered if count)


def status_in_words(status: ExperimentStatusDocument) -> str:
    """The progress of an experiment as text."""
    text = f"{thousands(status.ended)} of {plural(status.runs, 'run')} finished: {counts_in_words(status.counts)}."
    if status.retried:
        text += f" Not counted: {plural(status.retried, 'failed or disturbed run')} replaced by another run."
    if status.disturbed:
        text += f" Measured on a disturbed machine: {plural(status.disturbed, 'run')}."
    if status.missing:
        text += f" {plural(status.missing, 'run')} not stored yet: the start is in progress or was interrupted."
    if status.left is not None and status.left_s:
        left = status.left.words(", including builds and evaluations")
        text += f" {left[0].upper()}{left[1:]}. Now: {status.phase}."
    return text


def varying(axes: Mapping[str, int]) -> list[str]:
    """Names of the axes with several values, from {axis: number of values}."""
    return [name for name, values in axes.items() if values > 1]


def default_axes(axes: Mapping[str, int]) -> tuple[str, str]:
    """The default axes of the grid: the first two that vary and fit on a page."""
    fitting = [name for name in varying(axes) if axes[name] <= MOST_COLUMNS]
    names = list(dict.fromkeys([*fitting, *varying(axes), *axes]))
    return names[0], names[1] if len(names) > 1 else names[0]


def axis_text(value: Value | None) -> str:
    """An axis value as a heading; None means that the axis does not apply."""
    return DASH if value is None else value_text(value)


def grid_view(grid: ExperimentGrid, search: Search) -> GridView:
    """The grid cut to the limits of a page. ``search`` finds the runs with given values."""
    rows, columns = grid.rows[:MOST_ROWS], grid.columns[:MOST_COLUMNS]
    lines = tuple(
        (
            axis_text(row),
            tuple(
                _entry(grid.cells.get((place, index)), {grid.row_axis: row, grid.column_axis: column}, search)
                for index, column in enumerate(columns)
            ),
        )
        for place, row in enumerate(rows)
    )
    parts = [
        f"{plural(len(values) - len(shown), 'value')} of {axis}"
        for axis, values, shown in ((grid.row_axis, grid.rows, rows), (grid.column_axis, grid.columns, columns))
        if len(shown) < len(values)
    ]
    return GridView(grid.row_axis, grid.column_axis, tuple(map(axis_text, columns)), lines, " and ".join(parts))


def heat_map(view: GridView, grid: ExperimentGrid, metric: Metric, means: MetricGrid) -> GridView:
    """The same grid with the means of a metric, coloured by value; each dataset by itself if it is an axis."""
    factor = display_unit(metric).factor
    places = [
        (row, column) for row, (_, entries) in enumerate(view.lines) for column, entry in enumerate(entries) if entry
    ]
    found = [means.cells.get(place) for place in places]
    axes = (grid.row_axis, grid.column_axis)
    axis = axes.index("dataset") if "dataset" in axes else None
    classes = [None if axis is None else place[axis] for place in places]
    heats = levels([None if mean is None else mean.mean for mean in found], classes, metric.direction)
    lines = [list(entries) for _, entries in view.lines]
    for (row, column), mean, heat in zip(places, found, heats, strict=True):
        entry = lines[row][column]
        if entry is None:
            continue
        cell = TableCell(DASH, f"no good run with {metric.label}", missing=True)
        if mean is not None:
            text = mean_text(mean.mean * factor, None if mean.std is None else mean.std * factor)
            cell = TableCell(text, f"mean of {plural(mean.n, 'good run')}", heat=heat)
        explanation = f"{entry.explanation}; {metric.label} {cell.text} {unit_of(metric)}".rstrip()
        lines[row][column] = replace(entry, value=cell, explanation=f"{explanation}, {cell.exact}")
    notes = [f"protocol {means.protocol.label}"] if means.protocol and metric.needs_protocol else []
    if means.other_runs:
        notes.append(f"{plural(means.other_runs, 'good run')} under other protocols left out")
    titles = [title for title, _ in view.lines]
    return replace(view, metric=metric, notes=tuple(notes), lines=tuple(zip(titles, map(tuple, lines), strict=True)))


def selection(run_ids: Sequence[int]) -> str:
    """The runs that the box of a configuration selects: the first ones, so that two boxes always fit."""
    return ",".join(map(str, run_ids[:MOST_COMPARED]))


def cell_lines(
    name: str,
    cells: Iterable[Cell],
    axes: Sequence[str],
    metrics: Sequence[Metric],
    labels: Mapping[str, str],
) -> list[CellLine]:
    """Lines of the results table of experiment ``name``. ``labels``: {fingerprint: name of the protocol}."""
    lines: list[CellLine] = []
    for cell in cells:
        values = tuple(axis_text(cell.values.get(axis)) for axis in axes)
        figures = cell.figures or (NO_FIGURES,)
        lines += [
            CellLine(
                cell=cell,
                first=place == 0,
                title=cell.name.removeprefix(f"{name}-"),
                selects=selection([run.id for run in cell.runs if run.state in JUDGED and not run.retried]),
                values=values,
                progress=counts_in_words(cell.counts) + _disturbed(cell),
                failures=failures_in_words(cell.failures),
                protocol=_protocol(entry, labels),
                evaluated=entry.protocol is not None,
                figures=tuple(_figure(metric, entry.metrics.get(metric.key)) for metric in metrics),
            )
            for place, entry in enumerate(figures)
        ]
    return lines


def preview_facts(preview: ExperimentPreviewDocument) -> list[tuple[str, str]]:
    """The preview as names and texts."""
    combined = f"{thousands(preview.cells - preview.first_looks)} of {plural(preview.combinations, 'combination')}"
    looks = [("First looks", f"{thousands(preview.first_looks)} at clips")] if preview.first_looks else []
    identical = f", {thousands(preview.merged)} identical to another" if preview.merged else ""
    again = plural(preview.repeat_disturbed, "repeat")
    repeats = f"; up to {again} of each disturbed run, not counted here" if preview.repeat_disturbed else ""
    return [
        ("Configurations", combined + identical),
        *looks,
        ("Runs", thousands(preview.runs) + repeats),
        ("Existing", _known(preview)),
        ("Time", f"about {duration(preview.time_s)} on {plural(preview.slots, 'slot')}; {_time_basis(preview)}"),
        ("Variants", _variants(preview)),
        ("Run folders", f"about {size(preview.run_bytes)}"),
        ("Free disk", size(preview.free_bytes)),
        *([] if preview.to_fetch is None else [("To fetch", preview.to_fetch.words)]),
        ("Varies", " × ".join(f"{axis} {thousands(count)}" for axis, count in preview.axes.items()) or "nothing"),
    ]


def preview_axes(preview: ExperimentPreviewDocument) -> list[str]:
    """Columns of the preview table: algorithm, dataset and everything that varies."""
    varied = [name for axis in preview.axes for name in axis.split(" + ")]
    return list(dict.fromkeys(["algorithm", "dataset", *varied]))


def unit_of(metric: Metric) -> str:
    """The display unit of a metric."""
    return display_unit(metric).unit


def outcome_count(status: ExperimentStatusDocument, outcome: str) -> int:
    """Number of runs with one outcome."""
    return status.counts.get(Outcome(outcome), 0)


def _disturbed(cell: Cell) -> str:
    count = sum(bool(run.disturbed) and not run.retried for run in cell.runs)
    return f"; {thousands(count)} disturbed" if count else ""


def _protocol(figures: CellFigures, labels: Mapping[str, str]) -> str:
    if not figures.runs:
        return DASH
    name = "not evaluated" if figures.protocol is None else labels.get(figures.protocol, figures.protocol)
    return f"{name}, {plural(figures.runs, 'run')}"


def _known(preview: ExperimentPreviewDocument) -> str:
    if not preview.known_cells:
        return "none of the configurations"
    return f"{plural(preview.known_cells, 'configuration')} with {plural(preview.known_runs, 'run')}"


def _time_basis(preview: ExperimentPreviewDocument) -> str:
    between = f", and {duration(preview.between_s)} to prepare, collect and evaluate each run"
    if preview.measured_runs == preview.runs:
        return f"from earlier runs{between}"
    if preview.measured_runs:
        return f"{thousands(preview.measured_runs)} runs from earlier ones, the others from recording time{between}"
    return f"from recording time{between}"


def _variants(preview: ExperimentPreviewDocument) -> str:
    if not preview.variants:
        return "none"
    made = sum(need.made for need in preview.variants)
    text = "none to create"
    if to_make := len(preview.variants) - made:
        takes = f"about {duration(preview.variant_time_s)} of the time"
        text = f"{thousands(to_make)} to create, at most {size(preview.variant_bytes)} and {takes}"
    return f"{text}; {plural(made, 'variant')} exist already" if made else text


def _entry(found: GridCell | None, values: Mapping[str, Value | None], search: Search) -> GridEntry | None:
    if found is None:
        return None
    ended = sum(count for outcome, count in found.counts.items() if outcome.ended)
    told = (Outcome.FAILED, Outcome.LOST, Outcome.RUNNING, Outcome.CANCELLED)
    where = ", ".join(f"{axis} {axis_text(value)}" for axis, value in values.items())
    several = f" in {plural(found.cells, 'configuration')}" if found.cells > 1 else ""
    reasons = failures_in_words(found.failures)
    why = f"; failures: {reasons}" if reasons else ""
    return GridEntry(
        total=sum(found.counts.values()),
        ended=ended,
        segments=segments(found.counts),
        notes=tuple(f"{thousands(found.counts[entry])} {entry.label}" for entry in told if found.counts.get(entry)),
        explanation=f"{where}: {counts_in_words(found.counts)}{several}{why}",
        number=found.first if found.cells == 1 else None,
        search=None if found.cells == 1 else search(values, found.configurations),
    )


def _figure(metric: Metric, spread: MetricSpread | None) -> TableCell:
    """Mean, standard deviation and median of several runs; all digits and the number of runs on hover."""
    if spread is None:
        return TableCell(DASH, f"no {metric.label} known", missing=True)
    factor = display_unit(metric).factor
    text = mean_text(spread.mean * factor, None if spread.std is None else spread.std * factor)
    exact = f"mean {spread.mean!r} {metric.unit} of {plural(spread.n, 'run')}"
    if spread.std is not None:
        exact += f", standard deviation {spread.std!r}, median {spread.median!r}"
    return TableCell(text, exact, note=median_text(spread.n, spread.median * factor))


# -- the current activity as JSON for open pages -----------------------------------------------------------------------

ACTIVE_STATES = tuple(state for state in RunState if state.active)
MOST_ACTIVE = 50


def active_runs(hive: Hive) -> tuple[RunRecord, ...]:
    """The active runs, oldest first."""
    return hive.runs.page(matching(states=ACTIVE_STATES), RunSort("id", descending=False), None, MOST_ACTIVE).records


def snapshot(hive: Hive) -> dict[str, Any]:
    """Counts by state, evaluations that wait, whether a worker runs, and the progress of active runs."""
    return {
        "counts": {state.value: count for state, count in sorted(hive.runs.counts().items())},
        "unevaluated": hive.searches.unevaluated(),
        "evaluations": hive.evaluations.standing(),
        "worker": hive.worker_alive(),
        "active": [
            {"id": run.id, "state": run.state.value} | progress_json(hive.runs.progress(run.id))
            for run in active_runs(hive)
        ],
    }


def progress_json(progress: RunProgress | None) -> dict[str, Any]:
    """Progress as texts for the page; ``percent`` is None while unknown."""
    if progress is None:
        return {"percent": None, "text": "", "elapsed": DASH, "left": DASH, "cpu": DASH, "memory": DASH, "dropped": ""}
    cores = progress.cpu_cores
    return {
        "percent": None if progress.fraction is None else round(100 * progress.fraction, 1),
        "text": progress.text,
        "elapsed": duration(progress.elapsed_s),
        "left": duration(progress.left_s),
        "cpu": DASH if cores is None else f"{cores:.2f} cores",
        "memory": size(progress.memory_bytes),
        "dropped": "" if progress.dropped is None else f"{plural(progress.dropped, 'frame')} dropped",
    }
