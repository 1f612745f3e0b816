"""Latency of each frame over time, one line per run."""

from __future__ import annotations

from collections.abc import Mapping

from slamhive.analysis.chart import Axis, Chart
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
from slamhive.analysis.plot_types.recording_time import FROM_FIRST_FRAME, RECORDING_TIME, recording_starts
from slamhive.analysis.result import PlotResult, ResultTable, TableColumn
from slamhive.errors import InvalidInput

_MS_PER_S = 1e3


class Latency(base.PlotType[LineOptions]):
    """The plot type ``latency``."""

    key = "latency"
    title = "Latency over time"
    description = "The time from the arrival of each frame to its result; failed runs are dashed."
    options = LineOptions
    reads = frozenset({"latency.median", "latency.p95"})

    def build(self, data: base.PlotData, options: LineOptions) -> PlotResult:
        """One plot, a table of medians and percentiles, the samples."""
        table = data.table.require_runs()
        timed, excluded = read_runs(
            data, table.frame["run_id"], data.files.latency, options.most_runs, "no frame times"
        )
        if not timed:
            raise InvalidInput("no selected run reports when it finishes a frame", "imported runs do not")
        by = options.coloured_by or "algorithm"
        how = FOLDED if options.folded else "One line for each run; dashed: failed."
        starts_s = {entry.run_id: float(entry.timestamps_s[0]) for entry in timed} | recording_starts(data)
        curves = [
            Curve(entry.run_id, entry.timestamps_s - starts_s[entry.run_id], entry.latencies_s * _MS_PER_S)
            for entry in timed
        ]
        chart = Chart(
            key="latency",
            title=options.title or "Latency per frame",
            x=RECORDING_TIME,
            y=Axis("latency", "ms"),
            marks=(
                *lines_of(curves, table, looks_of(table, by, options.colour_order), folded=options.folded),
                *legend_of(table, by),
            ),
            caption=base.caption(table, len(timed), None, how, FROM_FIRST_FRAME, "Dropped frames have none."),
        )
        tables = (
            base.raw_table("latency", table, sorted(self.reads), "Medians and percentiles"),
            _samples(timed, starts_s),
        )
        return base.result_of(table, None, [chart], tables, excluded=excluded)


def _samples(timed: list[base.RunLatency], starts_s: Mapping[int, float]) -> ResultTable:
    columns = (
        TableColumn("run_id", "Run", links_run=True),
        TableColumn("time_s", "Recording time", "s"),
        TableColumn("latency_s", "Latency", "s"),
    )
    rows = tuple(
        (entry.run_id, float(at - starts_s[entry.run_id]), float(latency))
        for entry in timed
        for at, latency in zip(entry.timestamps_s, entry.latencies_s, strict=True)
    )
    return ResultTable("latency_samples", "Samples", columns, rows, raw=True)
