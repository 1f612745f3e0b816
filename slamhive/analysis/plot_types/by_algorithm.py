"""Accuracy by algorithm and dataset: mean and spread over repeats, failure rates, the best configuration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import PALETTE, Array, Axis, Bars, Chart, Mark
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import failed_marks, settings_words
from slamhive.analysis.report import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.statistics import Summary, summarise
from slamhive.analysis.table import FAILED, UNDER_LIMITS, RunTable
from slamhive.domain.metrics import Direction

_COSTS = ("cpu.mean", "ram.max")
"""What the table of the best configurations says besides the metric."""


class ByAlgorithmOptions(base.PlotOptions):
    """``of`` selects all runs, or those of the best configuration on each dataset."""

    metric: str = Field(default="ate.rmse", description="Metric to compare.")
    of: Literal["average", "best"] = Field(
        default="average", description="All configurations, or the best one of each algorithm and dataset."
    )
    by: base.GroupKey = "dataset"


class ByAlgorithm(base.PlotType[ByAlgorithmOptions]):
    """The plot type ``by_algorithm``."""

    key = "by_algorithm"
    title = "By algorithm and dataset"
    description = (
        "Mean, spread and failures of each algorithm on each dataset, or in another group, and over all groups; a "
        "table of the best configurations with what they cost."
    )
    options = ByAlgorithmOptions
    column_options = ("metric",)
    reads = frozenset(_COSTS)

    def build(self, data: base.PlotData, options: ByAlgorithmOptions) -> PlotResult:
        """Bars of means with spread, bars of failure rates, a table of the best configurations."""
        everything = data.table.require_runs().grouped_by(options.by)
        column = everything.numeric(options.metric, "a mean")
        protocol = everything.one_protocol([options.metric])
        chosen = best_configurations(everything, options.metric)
        table = everything if options.of == "average" else everything.with_rows(_only(everything, chosen))
        by = options.by
        x = Axis(everything.column(by).label, everything.column(by).unit, categories=everything.groups(by))
        shown = len(table.good().dropna(subset=[options.metric]))
        which = "all configurations" if options.of == "average" else "the best configuration of each"
        bars = tuple(_means(table, options.metric, x, by))
        marks: tuple[Mark, ...] = (*bars, *failed_marks(table, x, by))
        means = Chart(
            key=f"by_algorithm_{options.metric}",
            title=options.title or f"{column.label}, {which}",
            x=x,
            y=Axis(f"{column.label}, mean", column.unit),
            marks=marks,
            caption=base.caption(
                table,
                shown,
                protocol,
                f"Bars: mean over {_counts(bars)} runs; whiskers: one standard deviation; dark lines: median. "
                "Crosses above: failed runs.",
            ),
        )
        rates_of_failure: list[Bars] = []
        for algorithm, rows in table.frame.groupby("algorithm", sort=True):
            groups = [rows[rows[by] == name] for name in x.categories or ()]
            rates = [100 * float(group[FAILED].notna().mean()) if len(group) else np.nan for group in groups]
            texts = [f"{base.failed_count(group)} of {len(group)}" if len(group) else "" for group in groups]
            colour = table.colours[str(algorithm)]
            rates_of_failure.append(
                Bars(str(algorithm), np.array(rates), colour=colour, striped=True, texts=tuple(texts))
            )
        failures = Chart(
            key="failure_rate",
            title="Failed runs",
            x=x,
            y=Axis("Failed runs", "%"),
            marks=tuple(rates_of_failure),
            caption=base.caption(table, len(table.frame), protocol),
        )
        overall = []
        for algorithm, rows in table.frame.groupby("algorithm", sort=True):
            values = [base.good_values(group, options.metric) for _, group in rows.groupby(by, sort=True)]
            of_groups = np.array([group.mean() for group in values if len(group)])
            overall.append(_Overall(str(algorithm), of_groups, len(rows), base.failed_count(rows)))
        several = bool(shown) and len(x.categories or ()) > 1
        over_groups = [_overall_chart(table, options, overall, protocol)] if several else []
        result = base.result_of(
            table,
            protocol,
            [*([means] if shown else []), *([failures] if len(table.failed()) else []), *over_groups],
            (
                base.summary_table("by_algorithm", table, [options.metric], ["algorithm", by]),
                *([_overall_table(table, options, overall)] if several else []),
                _best_table(everything, options.metric, chosen),
                base.raw_table("by_algorithm_raw", table, [options.metric]),
            ),
            lacking=[options.metric],
        )
        notes = [] if result.failed else ["No run of the selection failed."]
        notes += [] if shown else [f"No good run has a value of {column.label}."]
        return replace(result, notes=tuple(notes))


def best_configurations(table: RunTable, metric: str) -> dict[tuple[str, str], tuple[int, str]]:
    """{(algorithm, dataset): configuration and its limits in words} with the fewest failures.

    Among equals, the one with the best mean. A configuration under other limits of CPU or memory is another one.
    A configuration that fails more often is never better, however good its other runs are. If all runs of all
    configurations failed, the first configuration is named.
    """
    sign = -1.0 if table.column(metric).direction is Direction.HIGHER else 1.0
    best: dict[tuple[str, str], tuple[int, str]] = {}
    scores: dict[tuple[str, str], tuple[float, float]] = {}
    grouped = table.with_limits().groupby(["algorithm", "dataset", "configuration_id", UNDER_LIMITS], sort=True)
    for (algorithm, dataset, configuration, limits), rows in grouped:
        values = base.good_values(rows, metric)
        mean = sign * float(values.mean()) if len(values) else np.inf
        score = (float(rows[FAILED].notna().mean()), mean)
        key = (str(algorithm), str(dataset))
        if key not in scores or score < scores[key]:
            scores[key], best[key] = score, (int(configuration), str(limits))
    return best


def _only(table: RunTable, chosen: dict[tuple[str, str], tuple[int, str]]) -> pd.DataFrame:
    columns = ["algorithm", "dataset", "configuration_id", UNDER_LIMITS]
    rows = table.with_limits()[columns].itertuples(index=False, name=None)
    return table.frame[[chosen.get((algorithm, dataset)) == tuple(own) for algorithm, dataset, *own in rows]]


def _means(table: RunTable, metric: str, x: Axis, by: str) -> Iterator[Bars]:
    for algorithm, rows in table.frame.groupby("algorithm", sort=True):
        found = [_summary(rows[rows[by] == name], metric) for name in x.categories or ()]
        heights = np.array([np.nan if entry is None else entry.mean for entry in found])
        spread = np.array([0.0 if entry is None or entry.std is None else entry.std for entry in found])
        yield Bars(
            name=str(algorithm),
            heights=heights,
            low=np.maximum(heights - spread, 0.0),
            high=heights + spread,
            medians=np.array([np.nan if entry is None else entry.median for entry in found]),
            colour=table.colours[str(algorithm)],
            texts=tuple("" if entry is None else f"n = {entry.count}" for entry in found),
        )


def _counts(bars: Sequence[Bars]) -> str:
    """Number of runs that the bars average: ``5`` or ``1 to 5``."""
    counts = sorted({int(text.removeprefix("n = ")) for bar in bars for text in bar.texts or () if text})
    return " to ".join(map(str, dict.fromkeys((counts[0], counts[-1])))) if counts else "no"


def _summary(rows: pd.DataFrame, metric: str) -> Summary | None:
    return summarise(base.good_values(rows, metric))


@dataclass(frozen=True, slots=True)
class _Overall:
    """The groups of one algorithm together. ``means`` are those of the groups that have a good run with a value."""

    algorithm: str
    means: Array
    runs: int
    failed: int

    @property
    def mean(self) -> float:
        return float(self.means.mean()) if len(self.means) else np.nan

    @property
    def std(self) -> float:
        return float(self.means.std(ddof=1)) if len(self.means) > 1 else np.nan

    @property
    def words(self) -> str:
        return f"{len(self.means)} groups, {100 * self.failed / self.runs:.0f} % failed"


def _overall_chart(
    table: RunTable, options: ByAlgorithmOptions, overall: Sequence[_Overall], protocol: str | None
) -> Chart:
    column, group = table.column(options.metric), table.column(options.by).label.lower()
    means = np.array([entry.mean for entry in overall])
    spread = np.nan_to_num(np.array([entry.std for entry in overall]))
    bars = Bars(
        name="mean",
        heights=means,
        low=np.maximum(means - spread, 0.0),
        high=means + spread,
        colour=PALETTE[0],
        texts=tuple(entry.words for entry in overall),
    )
    return Chart(
        key=f"over_groups_{options.metric}",
        title=f"{column.label} over each {group}",
        x=Axis("Algorithm", categories=tuple(entry.algorithm for entry in overall)),
        y=Axis(f"{column.label}, mean of means", column.unit),
        marks=(bars,),
        caption=base.caption(
            table,
            len(table.good().dropna(subset=[options.metric])),
            protocol,
            f"Bars: mean of the means of each {group}; whiskers: one standard deviation of these means. "
            "The hover text has the share of runs that failed.",
        ),
    )


def _overall_table(table: RunTable, options: ByAlgorithmOptions, overall: Sequence[_Overall]) -> ResultTable:
    column = table.column(options.metric)
    columns = (
        TableColumn("algorithm", "Algorithm"),
        TableColumn("groups", "Groups"),
        TableColumn("mean", f"{column.label} mean of means", column.unit),
        TableColumn("std", f"{column.label} std of means", column.unit),
        TableColumn("runs", "Runs"),
        TableColumn("failed", "Failed"),
        TableColumn("failure_rate", "Failed", "%"),
    )
    rows = tuple(
        (
            entry.algorithm,
            len(entry.means),
            base.plain_cell(entry.mean),
            base.plain_cell(entry.std),
            entry.runs,
            entry.failed,
            100 * entry.failed / entry.runs,
        )
        for entry in overall
    )
    note = "Each group counts once, however many good runs it has. Groups without a good run are left out of the mean."
    return ResultTable("over_groups", f"Over each {table.column(options.by).label.lower()}", columns, rows, note)


def _best_table(table: RunTable, metric: str, chosen: dict[tuple[str, str], tuple[int, str]]) -> ResultTable:
    column = table.column(metric)
    known_costs = [cost for cost in _COSTS if cost in table.columns]
    columns = (
        TableColumn("algorithm", "Algorithm"),
        TableColumn("dataset", "Dataset"),
        TableColumn("configuration_id", "Best configuration"),
        TableColumn("settings", "Settings"),
        TableColumn("mean", f"{column.label} mean", column.unit),
        TableColumn("median", f"{column.label} median", column.unit),
        TableColumn("std", f"{column.label} std", column.unit),
        *(TableColumn(cost.key, f"{cost.label} (mean)", cost.unit) for cost in map(table.column, known_costs)),
        TableColumn("runs", "Runs"),
        TableColumn("failed", "Failed"),
    )
    frame = table.with_limits().assign(settings=settings_words(table))
    rows: list[tuple[Cell, ...]] = []
    for (algorithm, dataset), (configuration, limits) in sorted(chosen.items()):
        group = frame[(frame["configuration_id"] == configuration) & (frame["dataset"] == dataset)]
        group = group[group[UNDER_LIMITS] == limits]
        summary = summarise(base.good_values(group, metric))
        spread = (None, None, None) if summary is None else (summary.mean, summary.median, summary.std)
        costs = [summarise(base.good_values(group, cost)) for cost in known_costs]
        means = [None if cost is None else cost.mean for cost in costs]
        counts = len(group), base.failed_count(group)
        rows.append((algorithm, dataset, configuration, group["settings"].iloc[0], *spread, *means, *counts))
    note = "The configuration with the fewest failures on the dataset; among equals, the one with the best mean."
    return ResultTable("best", "Best configurations", columns, tuple(rows), note)
