"""Names, counts and groups for searches, and saved searches. Lists of runs are in ``run_listing``.

Metrics of different protocols are never combined: a configuration that was evaluated under two has two of each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    FromClause,
    Select,
    and_,
    case,
    delete,
    func,
    insert,
    literal,
    not_,
    select,
    update,
)

from slamhive.base.errors import InvalidInput, unknown
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.run import FailureReason, RunState
from slamhive.filters.binding import Bound, Condition, Search, split_means
from slamhive.filters.fields import BUILT_IN, ParameterKind
from slamhive.filters.syntax import Sign, all_of, leaves
from slamhive.store.changes import changes_of
from slamhive.store.configurations import ConfigurationRepository
from slamhive.store.metrics import VERDICT
from slamhive.store.models import (
    MEASURED_PROTOCOL_ID,
    AlgorithmRow,
    ConfigurationRow,
    DatasetRow,
    EvaluationRow,
    MetricRow,
    ProtocolRow,
    RunRow,
    SavedSearchRow,
)
from slamhive.store.records import (
    Count,
    GroupPage,
    GroupRecord,
    ProtocolLabel,
    Repeats,
    RunSort,
    SavedSearchRecord,
    Spread,
)
from slamhive.store.rows import Repository, behind, changed, decode, encode, ordered
from slamhive.store.run_listing import LARGEST_PAGE, Matches
from slamhive.store.search_sql import FIGURES, RUNS, Names, Sql, among, look_up, stored_parameters

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


# -- runs grouped by configuration: how many, how many failed, and the spread of each metric over the others -----------


SORT_KEYS = ("configuration", "runs", "failed", "algorithm", "dataset")
"""What groups can be sorted by, besides the mean of every metric."""
_WIDE = 5
"""If a fifth of the runs fulfil a condition, finding their configurations takes longer than the means of all do."""
MOST_REPEATS = 100
"""So many values of a configuration are read to draw them."""


@dataclass(frozen=True)
class Groups:
    """The configurations of the runs that a search finds, in one order."""

    connection: Connection
    search: Search
    names: Names
    sql: Sql
    sort: RunSort
    of_runs: Bound | None
    """The conditions on single runs."""
    of_means: Bound | None
    """The conditions on the means of configurations."""

    @classmethod
    def of(cls, connection: Connection, search: Search, sort: RunSort) -> Groups:
        """The groups of ``search``; raises NotFound for an unknown protocol or sort key."""
        if sort.key not in SORT_KEYS and sort.key not in CATALOGUE:
            raise unknown("sort key of groups", sort.key, [*SORT_KEYS, *CATALOGUE])
        of_runs, of_means = split_means(search)
        names = look_up(connection, search)
        return cls(connection, replace(search, tree=of_runs), names, Sql(names, of_runs), sort, of_runs, of_means)

    def page(self, after: str | None, limit: int, metrics: Sequence[str]) -> GroupPage:
        """One page, with mean and spread of ``metrics`` over the repeats."""
        if not 1 <= limit <= LARGEST_PAGE:
            raise InvalidInput(f"page size {limit} is not allowed", f"use 1 to {LARGEST_PAGE}")
        kind = str if self.sort.key in {"algorithm", "dataset"} else float
        key = None if after is None else decode(after, (int,) if self.sort.key == "configuration" else (kind, int))
        found = self
        if self.of_means is not None:
            # The numbers of the configurations whose means fit take the place of the means. They are read once: each
            # statement of a page would compute the means again.
            most = (self.connection.execute(select(func.max(RUNS.c.id))).scalar_one() or 0) // _WIDE
            wide = []
            for leaf in leaves(self.of_means):
                some = self.sql.some_value(leaf)
                if some is not None:
                    first = some[1].limit(most + 1).subquery()
                    if self.connection.execute(select(func.count()).select_from(first)).scalar_one() > most:
                        wide.append(leaf)
            sql = Sql(self.names, self.of_runs, wide)
            rows = ConfigurationRow.__table__.alias()
            numbered = select(rows.c.id.label("configuration_id")).subquery()
            fitting = select(numbered.c.configuration_id).where(sql.test(self.of_means, numbered))
            chosen = Condition(
                BUILT_IN["configuration"], Sign.IN, tuple(self.connection.execute(fitting).scalars().all())
            )
            search = replace(self.search, tree=all_of([self.of_runs, chosen]))
            found = replace(self, search=search, of_means=None)
        runs, few = Matches(self.connection, found.search, self.sql).survey()
        page = found._many(key, limit + 1) if few is None else self._few(few, key, limit + 1)
        listed = [tuple(row) for row in self.connection.execute(page)]
        shown = [row[-1] for row in listed[:limit]]
        next_key = encode(listed[limit - 1]) if len(listed) > limit else None
        return GroupPage(self._records(shown, metrics), runs, next_key)

    def _few(self, found: Sequence[int], key: list[Any] | None, limit: int) -> Select[Any]:
        runs = RUNS.alias()
        query = select(runs.c.configuration_id).where(among(runs.c.id, found))
        return self._aggregated(query, runs, key, limit)

    def _many(self, key: list[Any] | None, limit: int) -> Select[Any]:
        runs = RUNS.alias()
        if self.sort.key == "configuration":
            table = ConfigurationRow.__table__.alias()
            matching = select(runs.c.id).where(
                runs.c.configuration_id == table.c.id, self.sql.test(self.search.tree, runs)
            )
            query = select(table.c.id).where(matching.limit(1).scalar_subquery().is_not(None))
            return self._cut(query, [table.c.id], key, limit)
        query = select(runs.c.configuration_id).where(self.sql.test(self.search.tree, runs))
        return self._aggregated(query, runs, key, limit)

    def _aggregated(self, query: Select[Any], runs: FromClause, key: list[Any] | None, limit: int) -> Select[Any]:
        """The configurations of the runs of ``query``, sorted."""
        configuration = runs.c.configuration_id
        if self.sort.key == "configuration":
            return self._cut(query.distinct(), [configuration], key, limit)
        inner = query.with_only_columns(self._value(runs, query).label("key_0"), configuration.label("key_1")).group_by(
            configuration
        )
        if self.sort.key in CATALOGUE:
            inner = self._mean(query, runs)
        rows = inner.subquery()
        return self._cut(select(rows), [rows.c.key_0, rows.c.key_1], key, limit)

    def _value(self, runs: FromClause, query: Select[Any]) -> ColumnElement[Any]:  # noqa: ARG002
        if self.sort.key == "failed":
            return self._count_failed(runs)
        if self.sort.key in {"algorithm", "dataset"}:
            table = (AlgorithmRow if self.sort.key == "algorithm" else DatasetRow).__table__.alias()
            rows = ConfigurationRow.__table__.alias()
            named = select(table.c.name).where(
                rows.c.id == runs.c.configuration_id, table.c.id == rows.c[f"{self.sort.key}_id"]
            )
            return named.scalar_subquery()
        return func.count()

    def _mean(self, query: Select[Any], runs: FromClause) -> Select[Any]:
        """The mean of a metric over the runs that did not fail.

        None if several protocols computed it: their metrics have no common mean.
        """
        figures, joined = self._figures(runs, [self.sort.key])
        one = func.min(figures.c.protocol_id) == func.max(figures.c.protocol_id)
        return (
            query.with_only_columns(
                case((one, func.avg(figures.c.value))).label("key_0"), runs.c.configuration_id.label("key_1")
            )
            .outerjoin_from(runs, figures, and_(joined, not_(self.sql.failed(runs))))
            .group_by(runs.c.configuration_id)
        )

    def _figures(self, runs: FromClause, metrics: Sequence[str]) -> tuple[FromClause, ColumnElement[bool]]:
        """The values of some metrics for the rows of ``runs``, and how to join them."""
        figures = FIGURES.alias()
        ids = [self.names.metrics[key] for key in metrics if key in self.names.metrics]
        counts = figures.c.is_current + 0 == 1
        if self.names.protocol_id is not None:
            counts = figures.c.protocol_id.in_([MEASURED_PROTOCOL_ID, self.names.protocol_id])
        among = figures.c.metric_id.in_(ids)
        return figures, and_(among, figures.c.run_id == runs.c.id, counts)

    def _cut(
        self, query: Select[Any], columns: list[ColumnElement[Any]], key: list[Any] | None, limit: int
    ) -> Select[Any]:
        descending = self.sort.descending
        if key is not None:
            query = query.where(behind(columns, key, descending=descending))
        by_value = [columns[0].is_(None)] if len(columns) > 1 else []
        return query.order_by(*by_value, *ordered(columns, descending=descending)).limit(limit)

    def _count_failed(self, runs: FromClause) -> ColumnElement[Any]:
        """The failed runs; a lost one has no result either, but says nothing of its configuration."""
        lost = and_(runs.c.reason.is_not(None), runs.c.reason == FailureReason.LOST)
        return func.count(case((and_(self.sql.failed(runs), not_(lost)), 1)))

    def _records(self, ids: Sequence[int], metrics: Sequence[str]) -> tuple[GroupRecord, ...]:
        runs, table = RUNS.alias(), ConfigurationRow.__table__
        matching = [runs.c.configuration_id.in_(ids), self.sql.test(self.of_runs, runs)]
        everything = select(runs.c.configuration_id, func.count()).where(matching[0]).group_by(runs.c.configuration_id)
        of_all = {row[0]: int(row[1]) for row in self.connection.execute(everything)}
        failed = self._count_failed(runs)
        disturbed = func.count(case((runs.c.disturbed_by > "", 1)))
        counted = select(runs.c.configuration_id, func.count(), failed, disturbed).where(*matching)
        counted = counted.group_by(runs.c.configuration_id)
        numbers = {row[0]: (int(row[1]), int(row[2]), int(row[3])) for row in self.connection.execute(counted)}
        rows = self.connection.execute(
            select(table.c.id, AlgorithmRow.name, DatasetRow.name)
            .join(AlgorithmRow, AlgorithmRow.id == table.c.algorithm_id)
            .join(DatasetRow, DatasetRow.id == table.c.dataset_id)
            .where(table.c.id.in_(ids))
        ).all()
        described = {row[0]: row for row in rows}
        parameters = ConfigurationRepository(self.connection).parameters_of_all(ids)
        spreads = self._spreads(matching, runs, metrics)
        return tuple(
            GroupRecord(
                configuration_id=place,
                algorithm=described[place][1],
                dataset=described[place][2],
                parameters=parameters[place],
                runs=numbers[place][0],
                all_runs=of_all[place],
                failed=numbers[place][1],
                disturbed=numbers[place][2],
                figures=spreads.get(place, {}),
            )
            for place in ids
        )

    def _spreads(
        self, matching: list[ColumnElement[bool]], runs: FromClause, metrics: Sequence[str]
    ) -> dict[int, dict[ProtocolLabel | None, dict[str, Spread]]]:
        """{configuration: {protocol, None for measured: {metric: spread}}} of runs that did not fail, in two passes.

        It sums squared differences from the mean, not squares: squared bytes leave no digits for the spread. The median
        is the mean of the one or two values in the middle of the order, since SQLite and MySQL have no function for it.
        """
        figures, joined = self._figures(runs, metrics)
        keys = [runs.c.configuration_id, figures.c.metric_id, figures.c.protocol_id]
        mean = func.avg(figures.c.value).over(partition_by=keys).label("mean")
        place = func.row_number().over(partition_by=keys, order_by=figures.c.value).label("place")
        count = func.count().over(partition_by=keys).label("n")
        inner = (
            select(*keys, figures.c.value, mean, place, count)
            .join_from(runs, figures, joined)
            .where(*matching, not_(self.sql.failed(runs)))
            .subquery()
        )
        difference = inner.c.value - inner.c.mean
        in_the_middle = and_(2 * inner.c.place >= inner.c.n, 2 * inner.c.place <= inner.c.n + 2)
        groups = [inner.c.configuration_id, inner.c.metric_id, inner.c.protocol_id]
        query = select(
            *groups,
            func.count(),
            func.max(inner.c.mean),
            func.avg(case((in_the_middle, inner.c.value))),
            func.sum(difference * difference),
            func.min(inner.c.value),
            func.max(inner.c.value),
        ).group_by(*groups)
        metric_names = {number: key for key, number in self.names.metrics.items()}
        labels = {row.id: ProtocolLabel(row.fingerprint, row.label) for row in self.connection.execute(_protocols())}
        found: dict[int, dict[ProtocolLabel | None, dict[str, Spread]]] = {}
        for row in self.connection.execute(query):
            configuration_id, metric_id, protocol_id, n, average, middle, squares, low, high = tuple(row)
            label = None if protocol_id == MEASURED_PROTOCOL_ID else labels[protocol_id]
            std = math.sqrt(squares / (n - 1)) if n > 1 else None
            spread = Spread(int(n), float(average), float(middle), std, float(low), float(high))
            found.setdefault(configuration_id, {}).setdefault(label, {})[metric_names[metric_id]] = spread
        return found

    def repeats(self, ids: Sequence[int], metrics: Sequence[str]) -> Repeats:
        """The first values of ``metrics`` of these configurations, of the matching runs that did not fail."""
        runs = RUNS.alias()
        figures, joined = self._figures(runs, metrics)
        keys = [runs.c.configuration_id, figures.c.metric_id, figures.c.protocol_id]
        place = func.row_number().over(partition_by=keys, order_by=runs.c.id).label("place")
        inner = (
            select(*keys, figures.c.value, place)
            .join_from(runs, figures, joined)
            .where(runs.c.configuration_id.in_(ids), self.sql.test(self.of_runs, runs))
            .where(not_(self.sql.failed(runs)))
            .subquery()
        )
        query = select(inner).where(inner.c.place <= MOST_REPEATS).order_by(*inner.c[:3], inner.c.place)
        metric_names = {number: key for key, number in self.names.metrics.items()}
        fingerprints = {row.id: row.fingerprint for row in self.connection.execute(_protocols())}
        found: dict[tuple[int, str | None, str], list[float]] = {}
        for configuration_id, metric_id, protocol_id, value, _ in map(tuple, self.connection.execute(query)):
            protocol = None if protocol_id == MEASURED_PROTOCOL_ID else fingerprints[protocol_id]
            found.setdefault((configuration_id, protocol, metric_names[metric_id]), []).append(float(value))
        return found


def _protocols() -> Select[Any]:
    table = ProtocolRow.__table__
    return select(table.c.id, table.c.fingerprint, table.c.label)
