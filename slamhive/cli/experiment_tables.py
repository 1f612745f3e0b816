"""Experiments on the terminal: the plan, the progress, the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from slamhive.cli.output import print_table, tell
from slamhive.cli.visible import say
from slamhive.domain.numbers import plural
from slamhive.domain.parameters import Value
from slamhive.domain.verdict import DEFAULT_RULE
from slamhive.services.experiments import (
    GUESSED_START_S,
    NO_FIGURES,
    Cell,
    CellFigures,
    ExperimentPreview,
    ExperimentStatus,
    NodesPlan,
    Phase,
    Spread,
    Standing,
    failure_words,
    failures_text,
)

FIGURES = (
    ("ATE m", "ate.rmse", 1.0, "{:.4f}"),
    ("tracked", "tracked_fraction", 1.0, "{:.3f}"),
    ("CPU cores", "cpu.mean", 1.0, "{:.2f}"),
    ("RAM MB", "ram.max", 1e-6, "{:.0f}"),
    ("time s", "duration", 1.0, "{:.1f}"),
)
"""Heading, metric, factor and format of the metrics of a report."""


def print_preview(found: ExperimentPreview) -> None:
    """Print the preview of an experiment."""
    merged = f", {found.merged} of them identical to another" if found.merged else ""
    say(f"{found.name}: {found.combinations:,} combinations, {found.cells:,} configurations{merged}")
    varied = ", ".join(f"{axis} {count}" for axis, count in found.axes.items()) or "nothing varies"
    say(f"varied: {varied}")
    say(f"runs: {found.runs:,}; about {_time(found.time_s)} on {_places(found)}, {_basis(found)}")
    shares = [("to make variants", found.variant_time_s), ("to build packages", found.build_time_s)]
    parts = [f"{_time(time_s)} {words}" for words, time_s in shares if time_s]
    say(f"of this: {', '.join([*parts, f'{found.between_s:.1f} s to prepare, collect and evaluate each run'])}")
    if found.cluster is not None:
        say(_moved(found.cluster))
    if found.repeat_disturbed:
        say(f"disturbed runs: each is repeated up to {plural(found.repeat_disturbed, 'time')}, not counted here")
    if found.known_cells:
        say(f"stored already: {found.known_cells:,} of the configurations, with {found.known_runs:,} runs")
    missing = sum(not need.made for need in found.variants)
    say(
        f"variants: {len(found.variants)} needed, {missing} to be made, {found.variant_bytes / 1e6:,.0f} MB at most; "
        f"run folders: {found.run_bytes / 1e6:,.0f} MB; free: {found.free_bytes / 1e6:,.0f} MB"
    )
    if found.standing is not None:
        say(f"this experiment exists already: {found.standing}")
    axes = [axis for axis in found.rows[0].values if len({str(row.values.get(axis)) for row in found.rows}) > 1]
    print_table(
        ("name", *axes, "runs so far"),
        [(row.name, *(_value(row.values, axis) for axis in axes), row.known_runs or None) for row in found.rows],
        right=("runs so far",),
    )
    if found.cells > len(found.rows):
        say(f"… and {found.cells - len(found.rows):,} more")
    for text in found.warnings:
        tell(f"warning: {text}", style="yellow")
    for text in found.refusals:
        tell(f"refused: {text}", style="bold red")


def _places(found: ExperimentPreview) -> str:
    return plural(found.slots, "slot") if found.cluster is None else plural(found.slots, "node")


def _moved(cluster: NodesPlan) -> str:
    idle = cluster.nodes - cluster.used_nodes
    without_run = f"; {plural(idle, 'node')} without a run" if idle else ""
    return (
        f"data to move: {cluster.moved_bytes / 1e9:,.2f} GB in all, at most {cluster.node_bytes / 1e9:,.2f} GB "
        f"to a node, at {cluster.bytes_per_s / 1e6:.0f} MB/s{without_run}"
    )


def _basis(found: ExperimentPreview) -> str:
    if found.measured_runs == found.runs:
        return "by earlier runs"
    guess = f"by the length of the recordings and {GUESSED_START_S:g} s to start"
    return guess if not found.measured_runs else f"{found.measured_runs:,} by earlier runs, the others {guess}"


def print_status(status: ExperimentStatus) -> None:
    """Print the progress of one experiment."""
    counts = ", ".join(f"{count:,} {phase.label}" for phase, count in status.counts.items() if count)
    say(f"{status.name}: {status.standing}; {status.runs:,} runs of {status.cells:,} configurations: {counts}")
    if status.failures:
        found = (f"{failure_words(failure)} {count:,}" for failure, count in status.failures.items())
        say(f"failed: {', '.join(found)}")
    if status.retried:
        say(f"not counted: {plural(status.retried, 'failed or disturbed run')} that another run replaces")
    if status.disturbed:
        say(f"measured on a disturbed machine: {plural(status.disturbed, 'run')} (filter: disturbed = yes)")
    if status.standing is Standing.STORING:
        say(f"{status.missing:,} runs are not stored yet; starting the same file again completes it")
    if status.left is not None and status.left_s and status.standing is Standing.ACTIVE:
        say(f"{status.left.words(', including builds and evaluations')}; now: {status.phase}")


def print_statuses(found: Sequence[ExperimentStatus]) -> None:
    """Print one line for each experiment."""
    columns = ("no.", "name", "state", "configurations", "runs", *(phase.label for phase in Phase), "created (UTC)")
    rows = [
        (
            status.id,
            status.name,
            status.standing.value,
            status.cells,
            status.runs,
            *(status.counts[phase] or None for phase in Phase),
            f"{status.created_at:%Y-%m-%d %H:%M}",
        )
        for status in found
    ]
    print_table(columns, rows, right=("no.", "configurations", "runs", *(phase.label for phase in Phase)))


def print_report(status: ExperimentStatus, cells: Sequence[Cell], axes: Sequence[str]) -> None:
    """Print a row for each cell and protocol: counts, and mean ± standard deviation of the metrics."""
    ate, *others = (heading for heading, *_ in FIGURES)
    headings = (ate, "median", *others)
    columns = ("cell", *axes, "runs", "good", "failed", "failures", "disturbed", *headings, "protocol")
    rows = [_report_row(cell, figures, axes) for cell in cells for figures in cell.figures or (NO_FIGURES,)]
    numbers = ("cell", "runs", "good", "failed", "disturbed", *headings)
    print_table(columns, rows, right=numbers, spare=("failures", "time s", "disturbed", "median"))
    print_status(status)
    say("metrics: mean ± standard deviation of the runs that did not fail; failed ones are counted")
    say(DEFAULT_RULE.words)
    say("disturbed: how many of these were measured on a disturbed machine and are not replaced")


def _report_row(cell: Cell, figures: CellFigures, axes: Sequence[str]) -> tuple[Any, ...]:
    ate, *others = (_spread(figures.metrics.get(key), factor, form) for _, key, factor, form in FIGURES)
    _, key, factor, form = FIGURES[0]
    first = figures.metrics.get(key)
    return (
        cell.number,
        *(_value(cell.values, axis) for axis in axes),
        len(cell.runs),
        cell.counts[Phase.GOOD],
        sum(cell.failures.values()) or None,
        failures_text(cell),
        figures.disturbed or None,
        ate,
        None if first is None else form.format(first.median * factor),
        *others,
        figures.protocol[:8] if figures.protocol else None,
    )


def _spread(found: Spread | None, factor: float, form: str) -> str | None:
    if found is None:
        return None
    mean = form.format(found.mean * factor)
    return mean if found.std is None else f"{mean} ± {form.format(found.std * factor)}"


def _value(values: Mapping[str, Value], axis: str) -> str | None:
    value = values.get(axis)
    return None if value is None else " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
