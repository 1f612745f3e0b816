"""Experiments as JSON, for command line and web API."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.parameters import Value
from slamhive.domain.variant import variant_to_json
from slamhive.domain.verdict import DEFAULT_RULE
from slamhive.services.experiments.views import Cell, ExperimentPreview, ExperimentStatus, Grid, Phase
from slamhive.services.json_values import plain, timestamp


def preview_to_json(found: ExperimentPreview) -> dict[str, Any]:
    """The preview of an experiment; times in s, sizes in bytes."""
    return {
        "name": found.name,
        "description": found.description,
        "combinations": found.combinations,
        "cells": found.cells,
        "merged": found.merged,
        "runs": found.runs,
        "axes": dict(found.axes),
        "known_cells": found.known_cells,
        "known_runs": found.known_runs,
        "time_s": found.time_s,
        "variant_time_s": found.variant_time_s,
        "measured_runs": found.measured_runs,
        "slots": found.slots,
        "variants": [
            {
                "dataset": need.dataset,
                "steps": variant_to_json(need.variant),
                "key": need.key,
                "needed_bytes": need.needed_bytes,
                "make_s": need.make_s,
                "made": need.made,
            }
            for need in found.variants
        ],
        "variant_bytes": found.variant_bytes,
        "run_bytes": found.run_bytes,
        "free_bytes": found.free_bytes,
        "warnings": list(found.warnings),
        "refusals": list(found.refusals),
        "repeat_disturbed": found.repeat_disturbed,
        "standing": None if found.standing is None else found.standing.value,
        "rows": [
            {
                "cell": row.number,
                "name": row.name,
                "values": _values(row.values),
                "known": row.known,
                "known_runs": row.known_runs,
            }
            for row in found.rows
        ],
    }


def status_to_json(status: ExperimentStatus) -> dict[str, Any]:
    """The progress of an experiment."""
    return {
        "name": status.name,
        "description": status.description,
        "state": status.standing.value,
        "executor": status.executor,
        "priority": status.priority,
        "repeats": status.repeats,
        "created_at": timestamp(status.created_at),
        "cells": status.cells,
        "runs": status.runs,
        "missing": status.missing,
        "counts": _counts(status.counts),
        "retried": status.retried,
        "failures": {reason.value: count for reason, count in status.failures.items()},
        "disturbed": status.disturbed,
        "failed_if": DEFAULT_RULE.words,
        "left_s": status.left_s,
    }


def cell_to_json(cell: Cell) -> dict[str, Any]:
    """One cell with its runs, and its metrics by protocol."""
    return {
        "cell": cell.number,
        "name": cell.name,
        "configuration": cell.configuration_id,
        "values": _values(cell.values),
        "counts": _counts(cell.counts),
        "failures": {reason.value: count for reason, count in cell.failures.items()},
        "runs": [
            {
                "id": run.id,
                "seed": run.seed,
                "state": run.state.value,
                "reason": None if run.reason is None else run.reason.value,
                "verdict": None if run.judged is None else run.judged.value,
                "retried": run.retried,
                "disturbed": run.disturbed,
            }
            for run in cell.runs
        ],
        "figures": [
            {
                "protocol": figures.protocol,
                "runs": figures.runs,
                "disturbed": figures.disturbed,
                "metrics": {
                    key: {"n": found.n, "mean": found.mean, "std": found.std, "unit": CATALOGUE[key].unit}
                    for key, found in figures.metrics.items()
                },
            }
            for figures in cell.figures
        ],
    }


def grid_to_json(grid: Grid) -> dict[str, Any]:
    """Progress over two axes; ``row`` and ``column`` are indices of ``rows`` and ``columns``."""
    return {
        "row_axis": grid.row_axis,
        "column_axis": grid.column_axis,
        "rows": [None if value is None else plain(value) for value in grid.rows],
        "columns": [None if value is None else plain(value) for value in grid.columns],
        "cells": [
            {
                "row": row,
                "column": column,
                "cells": cell.cells,
                "first": cell.first,
                "counts": _counts(cell.counts),
                "failures": {reason.value: count for reason, count in cell.failures.items()},
            }
            for (row, column), cell in grid.cells.items()
        ],
    }


def _counts(counts: Mapping[Phase, int]) -> dict[str, int]:
    return {phase.value: count for phase, count in counts.items()}


def _values(values: Mapping[str, Value]) -> dict[str, Any]:
    return {axis: plain(value) for axis, value in values.items()}
