"""CPU and memory over time, one line for each run."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import Field

from slamhive.analysis.chart import Array, Axis, Chart, Line, Points
from slamhive.analysis.forms.base import (
    FORMS,
    Form,
    FormData,
    FormOptions,
    RunUsage,
    caption,
    raw_table,
    require_runs,
    result_of,
)
from slamhive.analysis.forms.places import legend
from slamhive.analysis.result import Exclusion, FormResult, ResultTable, TableColumn
from slamhive.analysis.table import RunTable
from slamhive.errors import InvalidInput

_MB = 1e-6
_MOST_POINTS = 600


class UsageOptions(FormOptions):
    """How many runs are drawn at most."""

    most_runs: int = Field(
        default=60, ge=1, le=500, description="More lines cannot be told apart: the first are drawn."
    )


class Usage(Form[UsageOptions]):
    """The plot type ``usage``."""

    key = "usage"
    title = "CPU and memory over time"
    description = "The sampled cores and memory of each run since its start, failed runs dashed."
    options = UsageOptions

    def needs(self, options: UsageOptions) -> frozenset[str]:
        """Means and peaks, for the table."""
        del options
        return frozenset({"cpu.mean", "cpu.max", "ram.max"})

    def build(self, data: FormData, options: UsageOptions) -> FormResult:
        """A plot of cores and one of memory, the table of means and peaks, the samples."""
        table = data.table
        require_runs(table)
        runs = [int(run) for run in table.frame["run_id"]]
        sampled: list[RunUsage] = []
        without: list[int] = []
        for place, run in enumerate(runs):
            if len(sampled) == options.most_runs:
                break
            data.progress(place / len(runs))
            usage = data.files.usage(run)
            without += [] if usage is not None else [run]
            sampled += [] if usage is None else [usage]
        if not sampled:
            raise InvalidInput("no selected run has sampled usage", "runs that were imported have none")
        left_over = runs[len(sampled) + len(without) :]
        text = caption(table, len(sampled), None, "One line for each run; dashed: failed.")
        charts = (
            Chart(
                key="usage_cpu",
                title=options.title or "CPU in use",
                x=Axis("time since the start of the run", "s"),
                y=Axis("CPU", "cores"),
                marks=tuple(_lines(sampled, table, "cpu")),
                caption=text,
            ),
            Chart(
                key="usage_memory",
                title=options.title or "Memory in use",
                x=Axis("time since the start of the run", "s"),
                y=Axis("memory", "MB"),
                marks=tuple(_lines(sampled, table, "memory")),
                caption=text,
            ),
        )
        excluded = (Exclusion("not sampled", tuple(without)), Exclusion("beyond the number drawn", tuple(left_over)))
        tables = (raw_table("usage", table, ["cpu.mean", "cpu.max", "ram.max"], "Means and peaks"), _samples(sampled))
        return result_of(table, None, charts, tables, excluded=excluded)


def _lines(sampled: list[RunUsage], table: RunTable, what: str) -> Iterator[Line | Points]:
    failed = set(table.failed()["run_id"])
    algorithms = dict(zip(table.frame["run_id"], table.frame["algorithm"], strict=True))
    for usage in sampled:
        values = usage.cpu_cores if what == "cpu" else usage.memory_bytes * _MB
        kept = _evenly(len(values))
        yield Line(
            name=f"run {usage.run_id}, {algorithms[usage.run_id]}",
            x=usage.times_s[kept],
            y=values[kept],
            colour=table.colours[algorithms[usage.run_id]],
            dashed=usage.run_id in failed,
            runs=usage.run_id,
            in_legend=False,
            group=algorithms[usage.run_id],
        )
    yield from legend(table, markers=False)


def _evenly(count: int) -> Array:
    return np.unique(np.linspace(0, count - 1, min(count, _MOST_POINTS)).astype(int))


def _samples(sampled: list[RunUsage]) -> ResultTable:
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


FORMS.register(Usage.key, Usage())
