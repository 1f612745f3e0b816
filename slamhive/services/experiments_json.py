"""Experiments as JSON: the one shape that the command line and the web API share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from slamhive.domain.parameters import Value
from slamhive.domain.run import FailureReason
from slamhive.domain.variant import variant_to_json
from slamhive.services.experiments.records import (
    Cell,
    ExperimentPreview,
    ExperimentStatus,
    Grid,
    Phase,
    Spread,
    VariantNeed,
)
from slamhive.services.run_json import plain


def preview_to_json(preview: ExperimentPreview) -> dict[str, Any]:
    """What a start would do; sizes in bytes, times in seconds."""
    return {
        "name": preview.name,
        "description": preview.description,
        "combinations": preview.combinations,
        "configurations": preview.cells,
        "merged": preview.merged,
        "runs": preview.runs,
        "axes": dict(preview.axes),
        "first": [
            {
                "number": row.number,
                "name": row.name,
                "values": _values(row.values),
                "known": row.known,
                "known_runs": row.known_runs,
            }
            for row in preview.rows
        ],
        "known_configurations": preview.known_cells,
        "known_runs": preview.known_runs,
        "time_s": preview.time_s,
        "measured_runs": preview.measured_runs,
        "slots": preview.slots,
        "variants": [_variant(need) for need in preview.variants],
        "variant_bytes": preview.variant_bytes,
        "run_bytes": preview.run_bytes,
        "free_bytes": preview.free_bytes,
        "warnings": list(preview.warnings),
        "refusals": list(preview.refusals),
        "standing": None if preview.standing is None else preview.standing.value,
    }


def status_to_json(status: ExperimentStatus) -> dict[str, Any]:
    """How far an experiment is."""
    return {
        "id": status.id,
        "name": status.name,
        "description": status.description,
        "standing": status.standing.value,
        "executor": status.executor,
        "priority": status.priority,
        "repeats": status.repeats,
        "created_at": status.created_at.isoformat(timespec="milliseconds"),
        "configurations": status.cells,
        "runs": status.runs,
        "missing": status.missing,
        "ended": status.ended,
        "counts": _counts(status.counts),
        "retried": status.retried,
        "failures": _failures(status.failures),
        "left_s": status.left_s,
    }


def cell_to_json(cell: Cell) -> dict[str, Any]:
    """A configuration of an experiment with its runs, and its figures for each protocol."""
    return {
        "number": cell.number,
        "name": cell.name,
        "configuration": cell.configuration_id,
        "values": _values(cell.values),
        "counts": _counts(cell.counts),
        "failures": _failures(cell.failures),
        "figures": [
            {
                "protocol": figures.protocol,
                "runs": figures.runs,
                "metrics": {key: _spread(spread) for key, spread in figures.metrics.items()},
            }
            for figures in cell.figures
        ],
        "runs": [
            {
                "id": run.id,
                "seed": run.seed,
                "state": run.state.value,
                "reason": None if run.reason is None else run.reason.value,
                "retried": run.retried,
                "protocol": run.protocol,
                "metrics": dict(run.metrics),
            }
            for run in cell.runs
        ],
    }


def grid_to_json(grid: Grid) -> dict[str, Any]:
    """Progress over two axes; ``row`` and ``column`` count from 0 in ``rows`` and ``columns``."""
    return {
        "row_axis": grid.row_axis,
        "column_axis": grid.column_axis,
        "rows": [None if value is None else plain(value) for value in grid.rows],
        "columns": [None if value is None else plain(value) for value in grid.columns],
        "cells": [
            {
                "row": row,
                "column": column,
                "configurations": found.cells,
                "first": found.first,
                "counts": _counts(found.counts),
            }
            for (row, column), found in grid.cells.items()
        ],
    }


def _variant(need: VariantNeed) -> dict[str, Any]:
    return {
        "dataset": need.dataset,
        "variant": variant_to_json(need.variant),
        "key": need.key,
        "needed_bytes": need.needed_bytes,
        "made": need.made,
    }


def _spread(spread: Spread) -> dict[str, Any]:
    return {"n": spread.n, "mean": spread.mean, "std": spread.std}


def _values(values: Mapping[str, Value]) -> dict[str, Any]:
    return {name: plain(value) for name, value in values.items()}


def _counts(counts: Mapping[Phase, int]) -> dict[str, int]:
    return {phase.value: counts.get(phase, 0) for phase in Phase}


def _failures(failures: Mapping[FailureReason, int]) -> dict[str, int]:
    return {reason.value: count for reason, count in failures.items()}
