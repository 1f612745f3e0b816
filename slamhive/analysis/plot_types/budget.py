"""Budget curves: error, failures and dropped frames over the CPU or memory that runs may use, and what is enough."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Array, Axis, Chart, Line, Points
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import failed_marks, legend, look_of
from slamhive.analysis.plot_types.parameters import mean_lines
from slamhive.analysis.report import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.statistics import CONFIDENCE, RESAMPLES, Interval, Numbers
from slamhive.analysis.table import FAILED, Column, RunTable
from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import Direction
from slamhive.domain.names import plural
from slamhive.domain.trust import DROPPED_FRAMES

BUDGETS = ("cpu_cores", "memory_mb")
"""The columns that are budgets of runs."""
MOST_BUDGETS = 4
_SEED = 0


class BudgetOptions(base.PlotOptions):
    """``budgets``: where less is cheaper. ``at_most`` takes the place of ``margin``."""

    budgets: list[str] = Field(
        default_factory=list,
        max_length=MOST_BUDGETS,
        description="Columns where less is cheaper; by default the CPU and memory limits that vary.",
    )
    metric: str = Field(default="ate.rmse", description="Metric to keep.")
    margin: float = Field(
        default=0.1, ge=0, le=10, description="A budget is enough if the mean is within this share of the best mean."
    )
    at_most: float | None = Field(
        default=None,
        description="In place of the margin: a mean that is good enough, in the unit of the metric.",
    )
    failing: float = Field(
        default=0.0, ge=0, le=1, description="Share of runs that may fail beyond the smallest share of all budgets."
    )


@dataclass(frozen=True, slots=True)
class Knee:
    """The smallest budget that is enough, None if none is.

    ``interval`` holds that of 95 % of the resamples, infinite where none is enough; None if no budget has two runs.
    ``certainty`` is the share of resamples with the same one.
    """

    value: float | None
    interval: Interval | None
    certainty: float | None


def find_knee(budgets: Sequence[float], scores: Sequence[Numbers], rule: BudgetOptions) -> Knee:
    """Find the smallest budget that is enough: its mean is near the best, and its runs fail no more often.

    The best is the smallest mean among the budgets with the smallest share of failures. The uncertainty is that of a
    percentile bootstrap over the runs of each budget (B. Efron, Annals of Statistics 7, 1979).

    Args:
        budgets: In ascending order.
        scores: (n,) of the runs of each budget, less is better; infinite for a failed run.
        rule: What is enough; its ``at_most`` is a score here.
    """
    place = _enough([values[np.newaxis, :] for values in scores], rule)[0]
    found = float(budgets[place]) if place < len(budgets) else None
    if max(map(len, scores), default=0) < 2:
        return Knee(found, None, None)
    rng = np.random.default_rng(_SEED)
    drawn = [values[rng.integers(0, len(values), (RESAMPLES, len(values)))] for values in scores]
    places = np.sort(_enough(drawn, rule))
    ends = [*map(float, budgets), np.inf]
    tail = (1 - CONFIDENCE) / 2
    low, high = (ends[places[min(len(places) - 1, int(share * len(places)))]] for share in (tail, 1 - tail))
    return Knee(found, Interval(low, high), float(np.mean(places == place)))


def _enough(scores: Sequence[Numbers], rule: BudgetOptions) -> Numbers:
    """The place of the smallest budget that is enough in each row, (rows,); the number of budgets if none is."""
    good = [np.isfinite(values) for values in scores]
    counts = np.array([entry.sum(axis=1) for entry in good], dtype=float)
    shares = np.array([1 - entry.mean(axis=1) for entry in good])
    sums = np.array([np.where(entry, values, 0.0).sum(axis=1) for entry, values in zip(good, scores, strict=True)])
    means = np.where(counts > 0, sums / np.maximum(counts, 1), np.inf)
    least = shares.min(axis=0)
    best = np.where(shares <= least, means, np.inf).min(axis=0)
    bound = best + rule.margin * np.abs(best) if rule.at_most is None else np.full(best.shape, rule.at_most)
    enough = np.isfinite(means) & (means <= bound) & (shares <= least + rule.failing + 1e-9)
    return np.where(enough.any(axis=0), enough.argmax(axis=0), len(scores))


@dataclass(frozen=True, slots=True)
class _Needed:
    """The knee of one algorithm on one dataset along one budget; ``runs`` are those that it follows from."""

    algorithm: str
    dataset: str
    column: Column
    knee: Knee
    runs: int

    @property
    def words(self) -> str:
        """``0.5 cores (95 %: 0.5 to 1)``."""
        value = f"{self.knee.value:g} {self.column.unit}".strip()
        if self.knee.interval is None:
            return f"{value} (one run of each: not certain)"
        low, high = self.knee.interval.low, self.knee.interval.high
        ends = f"{low:g} to {high:g}" if np.isfinite(high) else f"{low:g} or more than was tried"
        return f"{value} (95 %: {ends})" if low < high else f"{value} (95 %: no other)"


class BudgetCurves(base.PlotType[BudgetOptions]):
    """The plot type ``budget``."""

    key = "budget"
    title = "Budget curves"
    description = "Error, failures and dropped frames over the cores or memory that runs may use, and the least enough."
    options = BudgetOptions
    column_options = ("budgets", "metric")
    reads = frozenset({DROPPED_FRAMES})

    def build(self, data: base.PlotData, options: BudgetOptions) -> PlotResult:
        """Two plots for each budget, a table of the budgets that are enough, the raw data, a sentence for each."""
        table = data.table.require_runs()
        metric = base.directed(table, options.metric, "a mean")
        # A curve needs two values of its budget.
        keys = list(dict.fromkeys(options.budgets)) or [key for key in BUDGETS if table.frame[key].nunique() > 1]
        if not keys:
            raise InvalidInput(
                f"neither {' nor '.join(BUDGETS)} varies in the selection",
                "vary them (limits: {cpus: 0.5 | 1}), or name other budgets",
            )
        columns = [table.numeric(key, "a budget") for key in keys]
        for column in columns:
            if table.frame[column.key].nunique() < 2:
                raise InvalidInput(
                    f"{column.key!r} has one value in the selection", "select runs with two values or more"
                )
        protocol = table.one_protocol([metric.key])
        shown = base.with_values(table, [metric.key])
        needed = [entry for column in columns for entry in _needed(table, column, columns, options)]
        more = f" by more than {100 * options.failing:g} %" if options.failing else ""
        rule_words = f"mean {_bound_words(metric, options)}, and no more failures{more} than the budget with the fewest"
        charts: list[Chart] = []
        for column in columns:
            rows = table.with_rows(_with_most(table.frame, column, columns))
            charts += _charts(rows, column, metric, [entry for entry in needed if entry.column == column], options)
        caption = base.caption(
            table, len(shown), protocol, f"Dashed: the smallest budget that is enough: {rule_words}."
        )
        dropped = [key for key in (DROPPED_FRAMES,) if key in table.columns]
        tables = (
            _table(needed, rule_words),
            base.raw_table("budget_raw", table, [*(column.key for column in columns), metric.key, *dropped]),
        )
        result = base.result_of(
            table,
            protocol,
            [replace(chart, caption=caption) for chart in charts],
            tables,
            lacking=[*(column.key for column in columns), metric.key],
        )
        return replace(result, notes=tuple(_sentences(table, needed, columns, options)))


def _with_most(frame: pd.DataFrame, column: Column, columns: Sequence[Column]) -> pd.DataFrame:
    """The runs with a value of ``column`` and with the most of all other budgets."""
    rows = frame.dropna(subset=[column.key])
    for other in columns:
        if other.key != column.key:
            rows = rows[rows[other.key] == frame[other.key].max()]
    return rows


def _scores(rows: pd.DataFrame, metric: str, sign: float) -> Numbers:
    """Less is better; infinite for a failed run. Good runs without the metric are left out."""
    failed = rows[FAILED].notna().to_numpy(dtype=bool)
    values = np.where(failed, np.inf, sign * base.number_column(rows, metric))
    return values[~np.isnan(values)]


def _rule(table: RunTable, options: BudgetOptions) -> tuple[BudgetOptions, float]:
    """The options with ``at_most`` as a score, and the sign that makes scores of values."""
    sign = -1.0 if table.column(options.metric).direction is Direction.HIGHER else 1.0
    bound = None if options.at_most is None else sign * options.at_most
    return options.model_copy(update={"at_most": bound}), sign


def _needed(table: RunTable, column: Column, columns: Sequence[Column], options: BudgetOptions) -> Iterator[_Needed]:
    rule, sign = _rule(table, options)
    for (algorithm, dataset), rows in _with_most(table.frame, column, columns).groupby(["algorithm", "dataset"]):
        scored = [(float(value), _scores(group, options.metric, sign)) for value, group in rows.groupby(column.key)]
        scored = [(value, scores) for value, scores in scored if len(scores)]
        knee = find_knee([value for value, _ in scored], [scores for _, scores in scored], rule)
        yield _Needed(str(algorithm), str(dataset), column, knee, len(rows))


def _bound_words(metric: Column, options: BudgetOptions) -> str:
    if options.at_most is None:
        return f"{metric.label} within {100 * options.margin:g} % of the best"
    sign = ">=" if metric.direction is Direction.HIGHER else "<="
    return f"{metric.label} {sign} {options.at_most:g} {metric.unit}".strip()


def _charts(
    table: RunTable, column: Column, metric: Column, needed: Sequence[_Needed], options: BudgetOptions
) -> Iterator[Chart]:
    """The metric over one budget, and the shares of failed runs and of dropped frames."""
    good = table.good().dropna(subset=[metric.key])
    x = base.axis_of_numbers(column, table.frame)
    values = base.number_column(good, metric.key)
    ends = np.array([values.min(), values.max()]) if len(values) else np.zeros(0)
    title = options.title or f"{metric.label} over the {column.label}"
    yield Chart(
        key=f"budget_{column.key}_{metric.key}",
        title=title,
        x=x,
        y=base.axis_of_numbers(metric, good),
        marks=(
            *mean_lines(good, column.key, metric.key, table),
            *_knees(table, needed, ends),
            *failed_marks(table, x, column.key),
        ),
        caption="",
    )
    yield Chart(
        key=f"budget_{column.key}_failures",
        title=f"Failed runs and dropped frames over the {column.label}",
        x=x,
        y=Axis("runs failed, frames dropped (dashed)", "%"),
        marks=(*_shares(table, column), *_knees(table, needed, np.array([0.0, 100.0])), *legend(table)),
        caption="",
    )


def _knees(table: RunTable, needed: Sequence[_Needed], ends: Array) -> Iterator[Line]:
    for entry in needed:
        if entry.knee.value is not None and len(ends):
            look = look_of(table, entry.algorithm, entry.dataset)
            look["name"] += f" needs {entry.words}"
            yield Line(x=np.full(2, entry.knee.value), y=ends, dashed=True, **look)


def _shares(table: RunTable, column: Column) -> Iterator[Line | Points]:
    for (algorithm, dataset), rows in table.frame.groupby(["algorithm", "dataset"], sort=True):
        groups = list(rows.groupby(column.key))
        places = np.array([float(value) for value, _ in groups])
        failed = np.array([100 * base.failed_count(group) / len(group) for _, group in groups])
        look = look_of(table, str(algorithm), str(dataset))
        yield Line(x=places, y=failed, **look)
        texts = tuple(f"{base.failed_count(group)} of {len(group)} runs failed" for _, group in groups)
        yield Points(x=places, y=failed, marker=table.marker(str(algorithm), str(dataset)), texts=texts, **look)
        if DROPPED_FRAMES not in rows:
            continue
        # Runs that failed because they were too slow dropped frames too.
        known = rows.dropna(subset=[DROPPED_FRAMES])
        if len(known):
            means = known.groupby(column.key)[DROPPED_FRAMES].mean()
            x, y = means.index.to_numpy(dtype=float), 100 * means.to_numpy(dtype=float)
            yield Line(x=x, y=y, dashed=True, **look)


def _table(needed: Sequence[_Needed], rule_words: str) -> ResultTable:
    columns = (
        TableColumn("algorithm", "Algorithm"),
        TableColumn("dataset", "Dataset"),
        TableColumn("budget", "Budget"),
        TableColumn("enough", "Smallest that is enough"),
        TableColumn("low", "95 % from"),
        TableColumn("high", "95 % to"),
        TableColumn("certainty", "Resamples with the same", "%"),
        TableColumn("runs", "Runs"),
    )
    rows: list[tuple[Cell, ...]] = []
    for entry in needed:
        knee = entry.knee
        ends = (None, None) if knee.interval is None else (knee.interval.low, knee.interval.high)
        share = None if knee.certainty is None else 100 * knee.certainty
        rows.append(
            (
                *(entry.algorithm, entry.dataset, f"{entry.column.label} [{entry.column.unit or '1'}]"),
                *map(base.plain_cell, (knee.value, *ends, share, entry.runs)),
            )
        )
    note = f"Enough: {rule_words}. Empty: no budget that was tried is enough. 95 %: bootstrap over the runs."
    return ResultTable("budgets", "What is enough", columns, tuple(rows), note)


def _sentences(
    table: RunTable, needed: Sequence[_Needed], columns: Sequence[Column], options: BudgetOptions
) -> Iterator[str]:
    """One for each algorithm on each dataset: ``kiss-icp on room needs 0.5 cores and 500 MB for ...``."""
    bound = _bound_words(table.column(options.metric), options)
    for algorithm, dataset in dict.fromkeys((entry.algorithm, entry.dataset) for entry in needed):
        own = [entry for entry in needed if (entry.algorithm, entry.dataset) == (algorithm, dataset)]
        lacking = [entry for entry in own if entry.knee.value is None]
        if lacking:
            names = " and no ".join(entry.column.label for entry in lacking)
            yield f"{algorithm} on {dataset}: no {names} that was tried is enough for {bound} here."
            continue
        words = " and ".join(entry.words for entry in own)
        yield f"{algorithm} on {dataset} needs {words} for {bound} here.{_together(table, own, columns, options)}"


def _together(table: RunTable, own: Sequence[_Needed], columns: Sequence[Column], options: BudgetOptions) -> str:
    """Say so if the budgets, each found with the most of the others, are not known to be enough together."""
    if len(own) < 2:
        return ""
    rule, sign = _rule(table, options)
    frame = table.frame[(table.frame["algorithm"] == own[0].algorithm) & (table.frame["dataset"] == own[0].dataset)]
    least, most = frame, frame
    for entry in own:
        least = least[least[entry.column.key] == entry.knee.value]
        most = most[most[entry.column.key] == frame[entry.column.key].max()]
    scores = [_scores(rows, options.metric, sign) for rows in (least, most)]
    if not len(scores[0]):
        return (
            f" Each was tried with the most of the {plural(len(columns) - 1, 'other budget')}; together they were not."
        )
    return "" if find_knee([0.0, 1.0], scores, rule).value == 0.0 else " Together they are not enough."
