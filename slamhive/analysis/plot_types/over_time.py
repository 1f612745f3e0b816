"""CPU and memory over time, one line per run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from slamhive.analysis.chart import Array, Axis, Chart
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import (
    FOLDED,
    FROM_FIRST_FRAME,
    RECORDING_TIME,
    Curve,
    LineOptions,
    legend_of,
    lines_of,
    looks_of,
    read_runs,
    recording_starts,
)
from slamhive.analysis.report import PlotResult, ResultTable, TableColumn
from slamhive.base.errors import InvalidInput

_MOST_POINTS = 600
_MOST_NAMED = 5
_STARTUP = "startup"


class Usage(base.PlotType[LineOptions]):
    """The plot type ``usage``."""

    key = "usage"
    title = "CPU and memory over time"
    description = "CPU cores and memory of each run over the time of the recording; failed runs are dashed."
    options = LineOptions
    reads = frozenset({"cpu.mean", "cpu.max", "ram.max", _STARTUP})

    def build(self, data: base.PlotData, options: LineOptions) -> PlotResult:
        """A plot of CPU and one of memory, a table of means and peaks, the samples."""
        table = data.table.require_runs()
        # How long a run took from its start to its first frame, where that was measured.
        startups_s: dict[int, float] = {}
        if _STARTUP in table.frame:
            pairs = zip(table.frame["run_id"], base.number_column(table.frame, _STARTUP), strict=True)
            startups_s = {int(run): float(startup_s) for run, startup_s in pairs if np.isfinite(startup_s)}
        sampled, excluded = read_runs(
            data,
            table.frame["run_id"],
            lambda run: data.files.usage(run, startups_s.get(run)),
            options.most_runs,
            "not sampled",
        )
        if not sampled:
            raise InvalidInput("no selected run has sampled usage", "imported runs have none")
        by = options.coloured_by or "algorithm"
        how = FOLDED if options.folded else "One line for each run; dashed: failed."
        x, when, times_s = _time_axis(sampled, recording_starts(data))
        text = base.caption(table, len(sampled), None, how, when)
        charts = [
            Chart(
                key=f"usage_{y.label.lower()}",
                title=options.title or f"{y.label[0].upper()}{y.label[1:]} in use",
                x=x,
                y=y,
                marks=(
                    *lines_of(curves, table, looks_of(table, by, options.colour_order), folded=options.folded),
                    *legend_of(table, by),
                ),
                caption=text,
            )
            for y, curves in (
                (Axis("CPU", "cores"), [_curve(usage, times_s, usage.cpu_cores) for usage in sampled]),
                (
                    Axis("memory", "MB"),
                    [_curve(usage, times_s, usage.memory_bytes * base.MEGABYTES_PER_BYTE) for usage in sampled],
                ),
            )
        ]
        tables = (
            base.raw_table("usage", table, ["cpu.mean", "cpu.max", "ram.max"], "Means and peaks"),
            _samples(sampled),
        )
        return base.result_of(table, None, charts, tables, excluded=excluded)


def _time_axis(
    sampled: Sequence[base.RunUsage], starts_s: Mapping[int, float]
) -> tuple[Axis, str, Mapping[int, Array]]:
    """The axis, a sentence about it, and the times of the samples of each run on it.

    One run that does not say when its frames were played puts all runs on the time since their start: a plot has one
    axis.
    """
    without = [usage.run_id for usage in sampled if usage.clock is None or usage.run_id not in starts_s]
    if without:
        who = f"{'run' if len(without) == 1 else 'runs'} {', '.join(map(str, without[:_MOST_NAMED]))}"
        who += f" and {len(without) - _MOST_NAMED} more" if len(without) > _MOST_NAMED else ""
        verb = "does" if len(without) == 1 else "do"
        words = f"Over the time since the start of each run: {who} {verb} not state when a frame was played."
        return Axis("time since the start of the run", "s"), words, {run.run_id: run.times_s for run in sampled}
    times_s = {
        usage.run_id: usage.clock.timestamps_at(usage.times_s) - starts_s[usage.run_id]
        for usage in sampled
        if usage.clock is not None
    }
    return RECORDING_TIME, f"{FROM_FIRST_FRAME} Before it, programs load.", times_s


def _curve(usage: base.RunUsage, times_s: Mapping[int, Array], values: Array) -> Curve:
    kept = _evenly(len(values))
    return Curve(usage.run_id, times_s[usage.run_id][kept], values[kept])


def _evenly(count: int) -> Array:
    return np.unique(np.linspace(0, count - 1, min(count, _MOST_POINTS)).astype(int))


def _samples(sampled: list[base.RunUsage]) -> ResultTable:
    columns = (
        TableColumn("run_id", "Run", links_run=True),
        TableColumn("time_s", "Time since the start of the run", "s"),
        TableColumn("cpu_cores", "CPU", "cores"),
        TableColumn("memory_bytes", "Memory", "bytes"),
    )
    rows = tuple(
        (usage.run_id, float(at), float(cpu), float(memory))
        for usage in sampled
        for at, cpu, memory in zip(usage.times_s, usage.cpu_cores, usage.memory_bytes, strict=True)
    )
    return ResultTable("usage_samples", "Samples", columns, rows, raw=True)


# Latency of each frame over time, one line per run.


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
        tables = (
            base.raw_table("latency", table, sorted(self.reads), "Medians and percentiles"),
            ResultTable("latency_samples", "Samples", columns, rows, raw=True),
        )
        return base.result_of(table, None, [chart], tables, excluded=excluded)
