"""Names, counts and groups for searches, and saved searches. Lists of runs are in ``run_listing``."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import delete, func, insert, literal, select, update

from slamhive.base.errors import unknown
from slamhive.domain.run import RunState
from slamhive.filters.binding import Search
from slamhive.filters.fields import ParameterKind
from slamhive.store.changes import changes_of
from slamhive.store.metrics import VERDICT
from slamhive.store.models import (
    MEASURED_PROTOCOL_ID,
    AlgorithmRow,
    DatasetRow,
    EvaluationRow,
    MetricRow,
    ProtocolRow,
    RunRow,
    SavedSearchRow,
)
from slamhive.store.records import Count, GroupPage, Repeats, RunSort, SavedSearchRecord
from slamhive.store.rows import Repository, changed
from slamhive.store.run_groups import Groups
from slamhive.store.run_listing import Matches
from slamhive.store.search_sql import Sql, look_up, stored_parameters

_SAVED = SavedSearchRow.__table__


class SearchRepository(Repository):
    """Reads through indexes only: the runs that a search leaves out cost nothing."""

    def parameters(self) -> list[ParameterKind]:
        """Every parameter and variant option of any configuration."""
        return stored_parameters(self._connection)

    def protocols(self) -> dict[str, str]:
        """{fingerprint: label} of all protocols."""
        query = select(ProtocolRow.fingerprint, ProtocolRow.label).where(ProtocolRow.id != MEASURED_PROTOCOL_ID)
        return {row.fingerprint: row.label for row in self._connection.execute(query)}

    def unevaluated(self) -> int:
        """The number of successful runs with neither metrics of a protocol nor a queued or running evaluation."""
        runs, evaluations = RunRow.__table__, EvaluationRow.__table__
        waiting = select(literal(1)).where(evaluations.c.run_id == runs.c.id, evaluations.c.open == 1)
        query = select(func.count()).where(
            runs.c.current_protocol_id.is_(None), runs.c.state == RunState.SUCCEEDED, ~waiting.exists()
        )
        return self._number(query)

    def names(self) -> tuple[list[str], list[str]]:
        """The names of the stored algorithms and datasets."""
        found = [
            select(table.__table__.c.name).order_by(table.__table__.c.name) for table in (AlgorithmRow, DatasetRow)
        ]
        algorithms, datasets = (self._column(query) for query in found)
        return algorithms, datasets

    def metrics(self) -> list[str]:
        """The keys of the metrics that any run has."""
        query = select(MetricRow.key).where(MetricRow.key != VERDICT).order_by(MetricRow.id)
        return self._column(query)

    def exact_count(self, search: Search) -> int:
        """The number of matches, however long counting takes."""
        return self._matches(search).exact_count()

    def count(self, search: Search) -> Count:
        """The number of matches; exact up to ``run_listing.COUNTED``, and beyond if that is cheap."""
        return self._matches(search).survey()[0]

    def run_ids(self, search: Search) -> list[int]:
        """The ids of all matching runs, in order."""
        return sorted(self._connection.execute(self._matches(search).ids(None)).scalars())

    def total(self) -> int:
        """The number of all runs."""
        return self._number(select(func.count()).select_from(RunRow.__table__))

    def with_metrics(self, search: Search) -> dict[str, int]:
        """{metric: number of runs that have it} for the metrics that ``search`` compares."""
        sql = Sql(look_up(self._connection, search))
        found: dict[str, int] = {}
        for field in search.metrics:
            figures = sql.figures(field.name, by_value=True)
            counted = 0
            if figures is not None:
                query = figures[1].with_only_columns(func.count())
                counted = self._number(query)
            found[field.name] = counted
        return found

    def groups(self, search: Search, sort: RunSort, after: str | None, limit: int, metrics: Sequence[str]) -> GroupPage:
        """One page of the configurations of matching runs, with mean and spread of ``metrics`` over the repeats."""
        return Groups.of(self._connection, search, sort).page(after, limit, metrics)

    def repeats(self, search: Search, ids: Sequence[int], metrics: Sequence[str]) -> Repeats:
        """The first values of ``metrics`` of some configurations, of their matching runs that did not fail."""
        return Groups.of(self._connection, search, RunSort("configuration")).repeats(ids, metrics)

    # -- saved searches --------------------------------------------------------------------------------------------

    def save(self, record: SavedSearchRecord, now: datetime) -> bool:
        """Save under its name, replacing a search of that name; whether it is new."""
        values = saved_columns(record)
        changes_of(self._connection).searches = True
        if changed(self._connection, update(_SAVED).where(_SAVED.c.name == record.name).values(values)):
            return False
        self._connection.execute(insert(_SAVED).values(name=record.name, created_at=now, **values))
        return True

    def saved(self) -> list[SavedSearchRecord]:
        """All of them by name."""
        return [
            SavedSearchRecord(
                name=row.name,
                filter_text=row.filter_text,
                columns=tuple(row.shown_columns),
                sort=RunSort(row.sort, row.descending),
                grouped=row.grouped,
                pinned=row.pinned,
                colours=row.colours,
                sparks=row.sparks,
            )
            for row in self._connection.execute(select(_SAVED).order_by(_SAVED.c.name))
        ]

    def saved_named(self, name: str) -> SavedSearchRecord:
        """The one of this name; raises NotFound."""
        known = {record.name: record for record in self.saved()}
        if name not in known:
            raise unknown("saved search", name, list(known))
        return known[name]

    def delete_saved(self, name: str) -> None:
        """Delete it; raises NotFound."""
        self.saved_named(name)
        self._connection.execute(delete(_SAVED).where(_SAVED.c.name == name))
        changes_of(self._connection).searches = True

    def _matches(self, search: Search) -> Matches:
        return Matches(self._connection, search, Sql(look_up(self._connection, search)))


def saved_columns(record: SavedSearchRecord) -> dict[str, Any]:
    """The columns of a saved search, except name and time."""
    return {
        "filter_text": record.filter_text,
        "shown_columns": list(record.columns),
        "sort": record.sort.key,
        "descending": record.sort.descending,
        "grouped": record.grouped,
        "pinned": record.pinned,
        "colours": record.colours,
        "sparks": record.sparks,
    }
