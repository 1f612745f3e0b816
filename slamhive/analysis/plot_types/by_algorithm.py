"""Accuracy by algorithm and dataset: mean and spread over repeats, failure rates, the best configuration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Axis, Bars, Chart, Mark
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.places import failed_marks
from slamhive.analysis.result import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.statistics import Summary, summarise
from slamhive.analysis.table import FAILED, RunTable
from slamhive.domain.metrics import Direction


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
        "Mean, spread and failures of each algorithm on each dataset, or in another group; a table of the best "
        "configurations."
    )
    options = ByAlgorithmOptions
    column_options = ("metric",)

    def build(self, data: base.PlotData, options: ByAlgorithmOptions) -> PlotResult:
        """Bars of means with spread, bars of failure rates, a table of the best configurations."""
        everything = data.table.require_runs().grouped_by(options.by)
        column = everything.numeric(options.metric, "a mean")
        protocol = everything.one_protocol([options.metric])
        chosen = best_configurations(everything, options.metric)
        table = everything if options.of == "average" else everything.with_rows(_only(everything.frame, chosen))
        by = options.by
        x = Axis(everything.column(by).label, categories=tuple(sorted(everything.frame[by].unique())))
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
        failures = Chart(
            key="failure_rate",
            title="Failed runs",
            x=x,
            y=Axis("Failed runs", "%"),
            marks=tuple(_failure_rates(table, x, by)),
            caption=base.caption(table, len(table.frame), protocol),
        )
        result = base.result_of(
            table,
            protocol,
            [*([means] if shown else []), *([failures] if len(table.failed()) else [])],
            (
                base.summary_table("by_algorithm", table, [options.metric], ["algorithm", by]),
                _best_table(everything, options.metric, chosen),
                base.raw_table("by_algorithm_raw", table, [options.metric]),
            ),
            lacking=[options.metric],
        )
        notes = [] if result.failed else ["No run of the selection failed."]
        notes += [] if shown else [f"No good run has a value of {column.label}."]
        return replace(result, notes=tuple(notes))


def best_configurations(table: RunTable, metric: str) -> dict[tuple[str, str], int]:
    """{(algorithm, dataset): configuration} with the fewest failures; among equals, with the best mean.

    A configuration that fails more often is never better, however good its other runs are. If all runs of all
    configurations failed, the first configuration is named.
    """
    sign = -1.0 if table.column(metric).direction is Direction.HIGHER else 1.0
    best: dict[tuple[str, str], int] = {}
    scores: dict[tuple[str, str], tuple[float, float]] = {}
    grouped = table.frame.groupby(["algorithm", "dataset", "configuration_id"], sort=True)
    for (algorithm, dataset, configuration), rows in grouped:
        values = base.good_values(rows, metric)
        mean = sign * float(values.mean()) if len(values) else np.inf
        score = (float(rows[FAILED].notna().mean()), mean)
        key = (str(algorithm), str(dataset))
        if key not in scores or score < scores[key]:
            scores[key], best[key] = score, int(configuration)
    return best


def _only(frame: pd.DataFrame, chosen: dict[tuple[str, str], int]) -> pd.DataFrame:
    kept = [
        chosen.get((row.algorithm, row.dataset)) == row.configuration_id
        for row in frame[["algorithm", "dataset", "configuration_id"]].itertuples(index=False)
    ]
    return frame[kept]


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
    """How many runs the bars average: ``5`` or ``1 to 5``."""
    counts = sorted({int(text.removeprefix("n = ")) for bar in bars for text in bar.texts or () if text})
    return " to ".join(map(str, dict.fromkeys((counts[0], counts[-1])))) if counts else "no"


def _summary(rows: pd.DataFrame, metric: str) -> Summary | None:
    return summarise(base.good_values(rows, metric))


def _failure_rates(table: RunTable, x: Axis, by: str) -> Iterator[Bars]:
    for algorithm, rows in table.frame.groupby("algorithm", sort=True):
        groups = [rows[rows[by] == name] for name in x.categories or ()]
        rates = [100 * float(group[FAILED].notna().mean()) if len(group) else np.nan for group in groups]
        texts = [f"{base.failed_count(group)} of {len(group)}" if len(group) else "" for group in groups]
        colour = table.colours[str(algorithm)]
        yield Bars(str(algorithm), np.array(rates), colour=colour, striped=True, texts=tuple(texts))


def _best_table(table: RunTable, metric: str, chosen: dict[tuple[str, str], int]) -> ResultTable:
    column = table.column(metric)
    columns = (
        TableColumn("algorithm", "Algorithm"),
        TableColumn("dataset", "Dataset"),
        TableColumn("configuration_id", "Best configuration"),
        TableColumn("mean", f"{column.label} mean", column.unit),
        TableColumn("median", f"{column.label} median", column.unit),
        TableColumn("std", f"{column.label} std", column.unit),
        TableColumn("runs", "Runs"),
        TableColumn("failed", "Failed"),
    )
    rows: list[tuple[Cell, ...]] = []
    for (algorithm, dataset), configuration in sorted(chosen.items()):
        group = table.frame[(table.frame["configuration_id"] == configuration) & (table.frame["dataset"] == dataset)]
        summary = summarise(base.good_values(group, metric))
        spread = (None, None, None) if summary is None else (summary.mean, summary.median, summary.std)
        rows.append((algorithm, dataset, configuration, *spread, len(group), base.failed_count(group)))
    note = "The configuration with the fewest failures on the dataset; among equals, the one with the best mean."
    return ResultTable("best", "Best configurations", columns, tuple(rows), note)
