"""CPU and memory over time, one line per run."""

from __future__ import annotations

import numpy as np

from slamhive.analysis.chart import Array, Axis, Chart
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import (
    FOLDED,
    Curve,
    LineOptions,
    legend_of,
    lines_of,
    looks_of,
    read_runs,
)
from slamhive.analysis.result import PlotResult, ResultTable, TableColumn
from slamhive.errors import InvalidInput

_MOST_POINTS = 600


class Usage(base.PlotType[LineOptions]):
    """The plot type ``usage``."""

    key = "usage"
    title = "CPU and memory over time"
    description = "CPU cores and memory of each run over the time since its start; failed runs are dashed."
    options = LineOptions
    reads = frozenset({"cpu.mean", "cpu.max", "ram.max"})

    def build(self, data: base.PlotData, options: LineOptions) -> PlotResult:
        """A plot of CPU and one of memory, a table of means and peaks, the samples."""
        table = data.table.require_runs()
        sampled, excluded = read_runs(data, table.frame["run_id"], data.files.usage, options.most_runs, "not sampled")
        if not sampled:
            raise InvalidInput("no selected run has sampled usage", "imported runs have none")
        by = options.coloured_by or "algorithm"
        how = FOLDED if options.folded else "One line for each run; dashed: failed."
        text = base.caption(table, len(sampled), None, how)
        charts = [
            Chart(
                key=f"usage_{y.label.lower()}",
                title=options.title or f"{y.label[0].upper()}{y.label[1:]} in use",
                x=Axis("time since the start of the run", "s"),
                y=y,
                marks=(
                    *lines_of(curves, table, looks_of(table, by, options.colour_order), folded=options.folded),
                    *legend_of(table, by),
                ),
                caption=text,
            )
            for y, curves in (
                (Axis("CPU", "cores"), [_curve(usage, usage.cpu_cores) for usage in sampled]),
                (
                    Axis("memory", "MB"),
                    [_curve(usage, usage.memory_bytes * base.MEGABYTES_PER_BYTE) for usage in sampled],
                ),
            )
        ]
        tables = (
            base.raw_table("usage", table, ["cpu.mean", "cpu.max", "ram.max"], "Means and peaks"),
            _samples(sampled),
        )
        return base.result_of(table, None, charts, tables, excluded=excluded)


def _curve(usage: base.RunUsage, values: Array) -> Curve:
    kept = _evenly(len(values))
    return Curve(usage.run_id, usage.times_s[kept], values[kept])


def _evenly(count: int) -> Array:
    return np.unique(np.linspace(0, count - 1, min(count, _MOST_POINTS)).astype(int))


def _samples(sampled: list[base.RunUsage]) -> ResultTable:
    columns = (
        TableColumn("run_id", "Run", links_run=True),
        TableColumn("time_s", "Time", "s"),
        TableColumn("cpu_cores", "CPU", "cores"),
        TableColumn("memory_bytes", "Memory", "bytes"),
    )
    rows = tuple(
        (usage.run_id, float(at), float(cpu), float(memory))
        for usage in sampled
        for at, cpu, memory in zip(usage.times_s, usage.cpu_cores, usage.memory_bytes, strict=True)
    )
    return ResultTable("usage_samples", "Samples", columns, rows, raw=True)
