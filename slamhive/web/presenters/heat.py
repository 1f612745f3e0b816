"""Colours by value: how good each metric in a list is, compared with the others that are shown.

Only what can be compared is compared: good runs of the same dataset, and errors under the same protocol.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import replace

from slamhive.domain.metrics import CATALOGUE, Direction, Metric
from slamhive.store.records import RunRecord
from slamhive.web.formatting import Cell
from slamhive.web.presenters.runs import Row
from slamhive.web.presenters.search import GroupColumn, GroupRow

WORST = 6
"""The largest level; half of it is neither good nor bad."""
OUTER_SHARE = 0.1
"""The best and the worst tenth have the full colours, so that one outlier does not take the colour of the others."""

Class = Hashable


def coloured_runs(rows: Sequence[Row]) -> list[Row]:
    """The same rows with levels in the cells of metrics."""
    cells = [list(row.cells) for row in rows]
    for place, (column, _) in enumerate(rows[0].cells if rows else ()):
        metric = CATALOGUE.get(column.key)
        if metric is None:
            continue
        values = [_value(row.run, metric) for row in rows]
        found = levels(values, [_class_of(row.run, metric) for row in rows], metric.direction)
        for line, heat in zip(cells, found, strict=True):
            line[place] = (column, replace(line[place][1], heat=heat))
    return [replace(row, cells=tuple(line)) for row, line in zip(rows, cells, strict=True)]


def coloured_groups(rows: Sequence[GroupRow], columns: Sequence[GroupColumn]) -> list[GroupRow]:
    """The same rows with levels in their cells, by the means."""
    cells: list[list[Cell]] = [list(row.cells) for row in rows]
    for place, column in enumerate(columns):
        values = [row.means[place] for row in rows]
        classes = [_group_class(row, column.metric) for row in rows]
        for line, heat in zip(cells, levels(values, classes, column.metric.direction), strict=True):
            line[place] = replace(line[place], heat=heat)
    return [replace(row, cells=tuple(line)) for row, line in zip(rows, cells, strict=True)]


def levels(values: Sequence[float | None], classes: Sequence[Class], direction: Direction) -> list[int | None]:
    """The level of each value among those of its class: 0 is best, ``WORST`` is worst.

    None for a missing value, for equal values, and for a metric of which neither direction is better.
    """
    found: list[int | None] = [None] * len(values)
    if direction is Direction.NEUTRAL:
        return found
    known: dict[Class, list[tuple[int, float]]] = {}
    for place, (value, kind) in enumerate(zip(values, classes, strict=True)):
        if value is not None and math.isfinite(value):
            known.setdefault(kind, []).append((place, value))
    for members in known.values():
        low, high = _ends([value for _, value in members])
        for place, value in members if high > low else ():
            share = min(1.0, max(0.0, (value - low) / (high - low)))
            found[place] = round(WORST * (1 - share if direction is Direction.HIGHER else share))
    return found


def _ends(values: Sequence[float]) -> tuple[float, float]:
    """Where the full colours begin; the extremes where the inner values are all equal."""
    ordered = sorted(values)
    last = len(ordered) - 1
    low, high = ordered[math.floor(OUTER_SHARE * last)], ordered[math.ceil((1 - OUTER_SHARE) * last)]
    return (low, high) if high > low else (ordered[0], ordered[-1])


def _value(run: RunRecord, metric: Metric) -> float | None:
    """The metric of a run that did not fail: a failed run can have a small error over the little that it tracked."""
    failed = run.verdict is not None and run.verdict.failed
    return None if failed else (run.metrics or {}).get(metric.key)


def _class_of(run: RunRecord, metric: Metric) -> Class:
    protocol = run.protocol.fingerprint if metric.needs_protocol and run.protocol is not None else None
    return run.dataset, protocol


def _group_class(row: GroupRow, metric: Metric) -> Class:
    protocol = row.protocol.fingerprint if metric.needs_protocol and row.protocol is not None else None
    return row.group.dataset, protocol
