"""What the runs of an analysis can be drawn over: the names that a person chooses from while writing one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from slamhive.analysis.table import Column, ColumnKind, RunTable, metric_column
from slamhive.domain.attributes import ATTRIBUTE_KINDS
from slamhive.domain.metrics import CATALOGUE

MOST_LOOKED_AT = 200
"""Runs that are looked at, spread over all that are selected."""


@dataclass(frozen=True, slots=True)
class OfferedColumns:
    """Of ``looked_at`` of the ``runs``: metrics with values, and numbers and groups that differ among them."""

    runs: int = 0
    looked_at: int = 0
    metrics: tuple[Column, ...] = ()
    numbers: tuple[Column, ...] = ()
    groups: tuple[Column, ...] = ()


def spread_over(run_ids: Sequence[int], most: int = MOST_LOOKED_AT) -> tuple[int, ...]:
    """At most ``most`` of the runs, evenly spaced, so that they hold more than the first configuration."""
    return tuple(run_ids[:: -(-len(run_ids) // most)]) if run_ids else ()


def offered_columns(table: RunTable, measured: Sequence[str], runs: int) -> OfferedColumns:
    """From the table of the runs that are looked at, and the keys of ``measured`` metrics."""
    varied = [column for column in table.varied() if column.kind is not ColumnKind.METRIC]
    attributes = {kind.name for kind in ATTRIBUTE_KINDS}
    words = [table.columns[key] for key in ("dataset", *attributes) if key in table.columns and _differs(table, key)]
    return OfferedColumns(
        runs=runs,
        looked_at=len(table.frame),
        metrics=tuple(metric_column(key) for key in CATALOGUE if key in measured),
        numbers=tuple(column for column in varied if column.numeric),
        groups=tuple(dict.fromkeys([*words, *(column for column in varied if column.key != "algorithm")])),
    )


def _differs(table: RunTable, key: str) -> bool:
    return key == "dataset" or table.frame[key].nunique() > 1
