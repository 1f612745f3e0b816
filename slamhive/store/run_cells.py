"""Runs as rows of exported tables: only what the columns ask for is read, and no record is made for a run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, cast

from sqlalchemy import Connection, Row

from slamhive.domain.parameters import Value
from slamhive.domain.run import NO_NOTES, FailureReason, RunNotes, RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.filters.binding import Search
from slamhive.store.catalogue import NoteRepository
from slamhive.store.configurations import ConfigurationRepository
from slamhive.store.metrics import VERDICT, MetricRepository, kind_of
from slamhive.store.models import RunRow
from slamhive.store.records import RunSort
from slamhive.store.run_listing import PageKeys, run_query
from slamhive.store.search_sql import among


@dataclass(frozen=True)
class CellsWanted:
    """The parts of a run that a column reads.

    Args:
        columns: Columns of :func:`~slamhive.store.run_listing.run_query`.
        metrics: Keys of metrics; :data:`~slamhive.store.metrics.VERDICT` reads the stored verdict.
        parameters: Read the parameters of the configuration.
        notes: Read the note and the tags.
    """

    columns: frozenset[str] = frozenset()
    metrics: frozenset[str] = frozenset()
    parameters: bool = False
    notes: bool = False

    def __or__(self, other: CellsWanted) -> CellsWanted:
        """The parts that either of two columns reads."""
        return CellsWanted(
            self.columns | other.columns,
            self.metrics | other.metrics,
            self.parameters or other.parameters,
            self.notes or other.notes,
        )


_as_json = json.JSONEncoder(sort_keys=True).encode


@dataclass
class ParameterCells:
    """The parameters of a configuration, shared by its runs. ``text``: as JSON."""

    values: dict[str, Value] = field(default_factory=dict)

    @cached_property
    def text(self) -> str:
        """The values as a JSON object, keys in order."""
        return _as_json(self.values)


class RunCells(NamedTuple):
    """The parts that were read of one run; the rest is empty. ``row`` has the columns that were asked for."""

    row: Row[Any]
    metrics: dict[str, float]
    parameters: ParameterCells
    notes: RunNotes

    @property
    def state(self) -> RunState:
        """The state, if it was read."""
        return cast("RunState", self.row.state)

    @property
    def reason(self) -> FailureReason | None:
        """The reason of a failure, if it was read."""
        return cast("FailureReason | None", self.row.reason)

    @property
    def judged(self) -> VerdictKind | None:
        """The stored verdict on the run's evaluation; None if there is none."""
        return kind_of(self.metrics.get(VERDICT))


class RunCellPage(NamedTuple):
    """One page of rows. ``next_key``: asks for the next page; None at the end."""

    records: Sequence[RunCells]
    next_key: str | None


def list_cells(
    connection: Connection, search: Search, sort: RunSort, after: str | None, limit: int, wanted: CellsWanted
) -> RunCellPage:
    """Up to ``limit`` of the runs that match ``search``, in the order of ``sort``, from ``after`` on."""
    found = PageKeys.read(connection, search, sort, after, limit)
    query = run_query(found.protocol_id)
    names = {"id", "configuration_id"} | wanted.columns
    query = query.with_only_columns(*(column for column in query.selected_columns if column.key in names))
    rows = {row.id: row for row in connection.execute(query.where(among(RunRow.id, found.run_ids))).all()}
    metrics: dict[int, dict[str, float]] = {}
    if wanted.metrics:
        metrics = MetricRepository(connection).for_runs(
            found.run_ids, sorted(wanted.metrics - {VERDICT}), found.protocol_id, verdicts=VERDICT in wanted.metrics
        )
    parameters: dict[int, ParameterCells] = {}
    if wanted.parameters:
        used = {row.configuration_id for row in rows.values()}
        values = ConfigurationRepository(connection).parameters_of_all(used)
        parameters = {number: ParameterCells(entry) for number, entry in values.items()}
    notes = NoteRepository(connection).for_runs(found.run_ids) if wanted.notes else {}
    nothing: dict[str, float] = {}
    none = ParameterCells()
    return RunCellPage(
        [
            RunCells(
                rows[run_id],
                metrics.get(run_id, nothing),
                parameters.get(rows[run_id].configuration_id, none),
                notes.get(run_id, NO_NOTES),
            )
            for run_id in found.run_ids
        ],
        found.next_key,
    )
