"""The best configurations of an experiment, separately for each dataset."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from slamhive.services.experiments import Cell
from slamhive.store.records import GroupRecord, ProtocolLabel
from slamhive.web.presenters.experiments import axis_text
from slamhive.web.presenters.search import GroupColumn, GroupRow, group_columns, group_rows, mixed_protocols

RANKED = 5
"""Configurations in a ranking."""
MOST_RANKINGS = 12
"""Datasets with a ranking on a page; a table lists all configurations."""


@dataclass(frozen=True, slots=True)
class Ranking:
    """The best configurations on one dataset, with the metrics ``columns``; ``mixed`` are its protocols if several."""

    dataset: str
    columns: list[GroupColumn]
    rows: list[tuple[str, GroupRow]]
    mixed: list[ProtocolLabel]


def configuration_names(cells: Iterable[Cell], axes: Sequence[str]) -> dict[int, str]:
    """{configuration: its values on the axes besides the dataset}."""
    shown = [axis for axis in axes if axis != "dataset"]
    return {
        cell.configuration_id: ", ".join(
            axis_text(cell.values.get(axis)) if axis == "algorithm" else f"{axis} {axis_text(cell.values.get(axis))}"
            for axis in shown
        )
        for cell in cells
    }


def ranking(
    dataset: str, groups: Iterable[GroupRecord], metrics: Sequence[str], names: Mapping[int, str]
) -> Ranking | None:
    """The ranking of these configurations, which are in order; None if none has a value of the first metric."""
    columns = group_columns(metrics)
    rows = [row for row in group_rows(groups, columns) if row.protocol is not None and not row.cells[0].missing]
    if not rows:
        return None
    named = [(names.get(row.group.configuration_id) or f"{row.group.algorithm}, {row.parameters}", row) for row in rows]
    return Ranking(dataset, columns, named, mixed_protocols(row.protocol for row in rows))
