"""Lists of runs: search, sort by any column, metric or parameter, page by key."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from functools import lru_cache
from itertools import islice
from random import Random
from typing import Any

from sqlalchemy import (
    Column,
    ColumnElement,
    Connection,
    FromClause,
    Integer,
    Row,
    Select,
    Table,
    and_,
    case,
    func,
    literal,
    select,
)

from slamhive.base.errors import InvalidInput, unknown
from slamhive.documents.limits import RunOptions, StopWhen
from slamhive.domain.configuration import InputMap, Playback, variant_of
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.parameters import Value
from slamhive.domain.protocol import protocol_from_content, with_trajectory
from slamhive.domain.run import NO_NOTES, FailureReason, Host, RunNotes, RunState
from slamhive.domain.trust import Disturbance
from slamhive.domain.verdict import VerdictKind
from slamhive.filters.binding import Bound, Condition, Search
from slamhive.filters.fields import PARAMETER_PREFIX, FieldKind, Source
from slamhive.filters.syntax import PRESENCE, Junction
from slamhive.store.catalogue import NoteRepository
from slamhive.store.configurations import ConfigurationRepository
from slamhive.store.metrics import VERDICT, MetricRepository, kind_of
from slamhive.store.models import (
    AlgorithmRow,
    AlgorithmVersionRow,
    ConfigurationRow,
    DatasetRow,
    ExperimentRow,
    HostRow,
    ProtocolRow,
    RunRow,
)
from slamhive.store.records import AlgorithmVersion, Count, Page, ProtocolLabel, RunRecord, RunSort
from slamhive.store.rows import behind, decode, encode, ordered
from slamhive.store.search_sql import NULLABLE, RUNS, Sql, among, look_up, starts, stored_parameters

_RUNS: Table = RunRow.__table__
COLUMNS: dict[str, Column[Any]] = {
    "id": _RUNS.c.id,
    "configuration": _RUNS.c.configuration_id,
    "executor": _RUNS.c.executor,
    "owner": _RUNS.c.owner,
    "state": _RUNS.c.state,
    "reason": _RUNS.c.reason,
    "seed": _RUNS.c.seed,
    "priority": _RUNS.c.priority,
    "created_at": _RUNS.c.created_at,
    "started_at": _RUNS.c.started_at,
    "ended_at": _RUNS.c.ended_at,
}
NAMED = ("algorithm", "dataset", "experiment")
"""Columns that hold an id but sort by the name of its row."""

_KINDS: dict[str, type] = {
    **dict.fromkeys(("configuration", "seed", "priority"), int),
    **dict.fromkeys(("created_at", "started_at", "ended_at"), datetime),
    "state": RunState,
    "reason": FailureReason,
}
_TABLES: dict[str, Table] = {
    "algorithm": AlgorithmRow.__table__,
    "dataset": DatasetRow.__table__,
    "experiment": ExperimentRow.__table__,
}
SORT_KEYS = (*COLUMNS, *NAMED)
"""Sort keys, besides every metric of the catalogue and every parameter."""


def names_in_order(connection: Connection, sort: RunSort) -> tuple[tuple[int, str], ...]:
    """Id and name of the algorithms, datasets or experiments, in order, if runs are sorted by them."""
    if sort.key not in NAMED:
        return ()
    rows = connection.execute(select(_TABLES[sort.key].c.id, _TABLES[sort.key].c.name))
    found = [(int(row.id), str(row.name)) for row in rows]
    return tuple(sorted(found, key=lambda entry: entry[1], reverse=sort.descending))


def sorted_parameter(connection: Connection, key: str) -> tuple[str, ...]:
    """The parameter that ``key`` names; empty for another sort key. Raises NotFound for an unknown key."""
    if key in SORT_KEYS or key in CATALOGUE:
        return ()
    name = key.removeprefix(PARAMETER_PREFIX)
    known = {entry.name for entry in stored_parameters(connection)}
    if name not in known:
        raise unknown("sort key", key, [*SORT_KEYS, *CATALOGUE, *known])
    return (name,)


@dataclass(frozen=True)
class Order:
    """One order. Runs without a value come last in both directions; ties are ordered by id.

    Repeats share the parameters of their configuration, so these ties are ordered by configuration first, as the index
    is. ``names``: see :func:`names_in_order`.
    """

    sort: RunSort
    sql: Sql
    names: tuple[tuple[int, str], ...] = ()

    @property
    def kinds(self) -> tuple[type, ...]:
        """The types of a page key."""
        if self.sort.key == "id":
            return (int,)
        if self._parameter is not None:
            return (float, int, int)
        if self.sort.key in CATALOGUE:
            return (float, int)
        return (_KINDS.get(self.sort.key, str), int)

    def columns(self, runs: FromClause) -> list[ColumnElement[Any]]:
        """The values that sort rows of ``runs``, the run's id last."""
        if self.sort.key == "id":
            return [runs.c.id]
        ties = [runs.c.configuration_id] if self._parameter is not None else []
        return [self._value(runs), *ties, runs.c.id]

    def walk(self, tree: Bound | None, after: list[Any] | None, limit: int) -> list[Select[Any]]:
        """Queries whose rows, one after the other, are the list from ``after`` on: those with a value, then the others.

        Each reads along an index and stops after ``limit``, so it is fast where many runs match.
        """
        missing: list[Select[Any]] = []
        if not self._own(tree):
            runs = RUNS.alias()
            columns = self.columns(runs)
            rest = columns[1:]
            conditions = [self.sql.test(tree, runs), columns[0].is_(None)]
            if after is not None and after[0] is None and rest:
                conditions.append(behind(rest, after[1:], descending=self.sort.descending))
            query = select(*_labelled(columns)).where(*conditions)
            query = query.order_by(*ordered(rest or columns, descending=self.sort.descending)).limit(limit)
            missing.append(query)
        if after is not None and len(after) > 1 and after[0] is None:
            return missing
        if self.sort.key in CATALOGUE:
            runs = RUNS.alias()
            found = self.sql.figures(self.sort.key, by_value=True)
            if found is None:
                nothing = select(*_labelled(self.columns(runs))).where(runs.c.id < 0)
                return [nothing, *missing]
            figures, query = found
            columns = [figures.c.value, figures.c.run_id]
            query = query.where(*(self.sql.compare(figures.c.value, leaf) for leaf in self._own(tree)))
            pairs: Select[Any] = query.with_only_columns(*_labelled(columns)).select_from(figures, runs)
            of_run = runs.c.id == figures.c.run_id + 0
            pairs = pairs.where(of_run, self.sql.test(tree, runs), *self._from(columns, after))
            return [pairs.order_by(*ordered(columns, descending=self.sort.descending)).limit(limit), *missing]
        if self._parameter is not None:
            return [self._by_parameter(self._parameter, tree, after, limit), *missing]
        if self.sort.key in NAMED:
            named = [self._of_one_name(tree, number, name, after, limit) for number, name in self.names]
            return [*(query for query in named if query is not None), *missing]
        runs = RUNS.alias()
        columns = self.columns(runs)
        nullable = self._column in NULLABLE
        there = [columns[0].is_not(None)] if nullable else []
        query = select(*_labelled(columns)).where(self.sql.test(tree, runs), *there, *self._from(columns, after))
        query = query.order_by(*ordered(columns, descending=self.sort.descending)).limit(limit)
        return [query, *missing] if nullable else [query]

    @property
    def _column(self) -> str:
        return str(COLUMNS[self.sort.key].key)

    @property
    def _parameter(self) -> str | None:
        if self.sort.key in SORT_KEYS or self.sort.key in CATALOGUE:
            return None
        return self.sort.key.removeprefix(PARAMETER_PREFIX)

    def _own(self, tree: Bound | None) -> list[Condition]:
        """The comparisons, joined by ``and``, of the value that sorts the list. Every run that matches has a value."""
        parts = tree.parts if isinstance(tree, Junction) and tree.word == "and" else (tree,)
        parameter = self._parameter
        name = self.sort.key if parameter is None else parameter
        return [
            part
            for part in parts
            if isinstance(part, Condition)
            and part.field.name == name
            and part.sign not in PRESENCE
            and (part.field.source is Source.PARAMETER) == (parameter is not None)
            and (parameter is None or part.field.kind in {FieldKind.NUMBER, FieldKind.FLAG})
        ]

    def _value(self, runs: FromClause) -> ColumnElement[Any]:
        if self.sort.key in CATALOGUE:
            return self.sql.figure_of(self.sort.key, runs)
        if self._parameter is not None:
            return self.sql.parameter_of(self._parameter, runs)
        if self.sort.key in NAMED:
            return _name_of(self.sort.key, runs)
        return runs.c[self._column]

    def _from(self, columns: Sequence[ColumnElement[Any]], after: list[Any] | None) -> list[ColumnElement[bool]]:
        """The rows after ``after``. The first condition alone lets the database find the place in an index."""
        if after is None:
            return []
        if len(columns) == 1:
            return [behind(columns, after, descending=self.sort.descending)]
        near = columns[0] <= after[0] if self.sort.descending else columns[0] >= after[0]
        return [near, behind(columns, after, descending=self.sort.descending)]

    def _of_one_name(
        self, tree: Bound | None, number: int, name: str, after: list[Any] | None, limit: int
    ) -> Select[Any] | None:
        """The runs of one algorithm, dataset or experiment, by id; None if an earlier page has shown them all."""
        runs = RUNS.alias()
        if self.sort.key == "experiment":
            named: ColumnElement[bool] = runs.c.experiment_id == number
        else:
            rows = ConfigurationRow.__table__.alias()
            # ``+ 0`` keeps the index of the column from being used: the list is walked by run, and each is tested.
            own = rows.c[f"{self.sort.key}_id"] + 0 == number
            named = select(literal(1)).where(rows.c.id == runs.c.configuration_id, own).limit(1).scalar_subquery() == 1
        conditions = [named, self.sql.test(tree, runs)]
        if after is not None:
            if (name > after[0]) if self.sort.descending else (name < after[0]):
                return None
            if name == after[0]:
                conditions.append(behind([runs.c.id], after[1:], descending=self.sort.descending))
        query = select(*_labelled([literal(name), runs.c.id])).where(*conditions)
        return query.order_by(*ordered([runs.c.id], descending=self.sort.descending)).limit(limit)

    def _by_parameter(self, name: str, tree: Bound | None, after: list[Any] | None, limit: int) -> Select[Any]:
        """First the configurations with a matching run, in order; then their runs."""
        values, among = self.sql.parameter_rows(name)
        inner, runs = RUNS.alias(), RUNS.alias()
        descending = self.sort.descending
        matching = select(inner.c.id).where(
            inner.c.configuration_id == values.c.configuration_id, self.sql.test(tree, inner)
        )
        columns = [values.c.number_value, values.c.configuration_id]
        chosen = select(*columns).where(
            among,
            values.c.number_value.is_not(None),
            *(self.sql.compare(values.c.number_value, leaf) for leaf in self._own(tree)),
            matching.limit(1).scalar_subquery().is_not(None),
        )
        if after is not None:
            chosen = chosen.where(
                *self._from(columns, after[:2])[:1],
                behind([*columns], [*after[:2]], descending=descending)
                | and_(values.c.number_value == after[0], values.c.configuration_id == after[1]),
            )
        # One more than ``limit``: the configuration that ended the last page may have no runs left.
        first = chosen.order_by(*ordered(columns, descending=descending)).limit(limit + 1).subquery()
        shown = [first.c.number_value, first.c.configuration_id, runs.c.id]
        query = select(*_labelled(shown)).select_from(first, runs)
        query = query.where(runs.c.configuration_id == first.c.configuration_id + 0, self.sql.test(tree, runs))
        query = query.where(*([] if after is None else [behind(shown, after, descending=descending)]))
        return query.order_by(*ordered(shown, descending=descending)).limit(limit)


def _labelled(columns: Sequence[ColumnElement[Any]]) -> list[ColumnElement[Any]]:
    """The columns of a page key, named for outer queries."""
    return [column.label(f"key_{place}") for place, column in enumerate(columns)]


def _name_of(key: str, runs: FromClause) -> ColumnElement[Any]:
    table = _TABLES[key].alias()
    if key == "experiment":
        return select(table.c.name).where(table.c.id == runs.c.experiment_id).scalar_subquery()
    rows = ConfigurationRow.__table__.alias()
    query = select(table.c.name).where(rows.c.id == runs.c.configuration_id, table.c.id == rows.c[f"{key}_id"])
    return query.scalar_subquery()


# -- records from rows: one query for the runs, one for parameters, one for metrics ------------------------------------

_MORE_OPTIONS = tuple(option for option in fields(RunOptions) if option.name not in _RUNS.c)
"""The options without a column of their own; ``more_options`` holds those that are not at their defaults."""


def options_row(options: RunOptions) -> dict[str, Any]:
    """The columns of the options that are no column as they are."""
    values = ((option, getattr(options, option.name)) for option in _MORE_OPTIONS)
    more = {option.name: value for option, value in values if value != option.default}
    return {"stop_when": options.stop_when.content or None, "more_options": more or None}


def options_of_row(row: Row[Any]) -> dict[str, Any]:
    """The options that :func:`options_row` wrote, as keyword arguments."""
    stored = row.more_options or {}
    more = {option.name: stored.get(option.name, option.default) for option in _MORE_OPTIONS}
    return {"stop_when": StopWhen.of(row.stop_when), **more}


_CONVERTED = {"protocol_override", "stop_when", "disturbance"}
_AS_STORED = sorted(set(RunRecord.__dataclass_fields__) & set(RunRow.__table__.c.keys()) - _CONVERTED)
"""The fields of a record that are columns of ``runs`` as they are."""


@lru_cache(maxsize=64)
def run_query(protocol_id: int | None = None) -> Select[Any]:
    """All columns that a record needs; the caller adds conditions and order.

    ``protocol_id``: the protocol whose metrics are shown, None for each run's current one. The statement is kept:
    making it takes longer than executing it for one run.
    """
    shown = func.coalesce(literal(protocol_id, Integer), RunRow.current_protocol_id)
    return (
        select(
            RunRow.__table__,
            AlgorithmRow.name.label("algorithm"),
            AlgorithmRow.package.label("package"),
            DatasetRow.name.label("dataset"),
            ConfigurationRow.playback_mode,
            ConfigurationRow.playback_rate,
            ConfigurationRow.variant,
            ConfigurationRow.sensors,
            ConfigurationRow.version.label("asked_version"),
            ConfigurationRow.map.label("input_map"),
            ProtocolRow.fingerprint.label("protocol_fingerprint"),
            ProtocolRow.label.label("protocol_label"),
            AlgorithmVersionRow.identity,
            AlgorithmVersionRow.package_hash,
            AlgorithmVersionRow.version,
            AlgorithmVersionRow.number.label("version_number"),
            HostRow.cpu_model,
            HostRow.cpu_count,
            HostRow.memory_bytes,
            HostRow.kernel,
            HostRow.os,
            ExperimentRow.name.label("experiment"),
        )
        .join(ConfigurationRow, ConfigurationRow.id == RunRow.configuration_id)
        .join(AlgorithmRow, AlgorithmRow.id == ConfigurationRow.algorithm_id)
        .join(DatasetRow, DatasetRow.id == ConfigurationRow.dataset_id)
        .outerjoin(ProtocolRow, ProtocolRow.id == shown)
        .outerjoin(AlgorithmVersionRow, AlgorithmVersionRow.id == RunRow.algorithm_version_id)
        .outerjoin(HostRow, HostRow.id == RunRow.host_id)
        .outerjoin(ExperimentRow, ExperimentRow.id == RunRow.experiment_id)
    )


def to_records(
    connection: Connection, rows: Sequence[Row[Any]], *, with_metrics: bool = False, protocol_id: int | None = None
) -> tuple[RunRecord, ...]:
    """The rows of :func:`run_query` as records, in the same order, with metrics of the same protocol."""
    parameters = ConfigurationRepository(connection).parameters_of_all(row.configuration_id for row in rows)
    run_ids = [row.id for row in rows]
    notes = NoteRepository(connection).for_runs(run_ids)
    if not with_metrics:
        return tuple(_record(row, parameters[row.configuration_id], notes=notes.get(row.id, NO_NOTES)) for row in rows)
    metrics = MetricRepository(connection).for_runs(run_ids, protocol_id=protocol_id, verdicts=True)
    kinds = {run_id: kind_of(values.pop(VERDICT, None)) for run_id, values in metrics.items()}
    return tuple(
        _record(
            row,
            parameters[row.configuration_id],
            metrics[row.id],
            kinds[row.id],
            notes=notes.get(row.id, NO_NOTES),
        )
        for row in rows
    )


def _record(
    row: Row[Any],
    parameters: dict[str, Value],
    metrics: dict[str, float] | None = None,
    judged: VerdictKind | None = None,
    *,
    notes: RunNotes,
) -> RunRecord:
    override, fingerprint = row.protocol_override, row.protocol_fingerprint
    return RunRecord(
        **{name: getattr(row, name) for name in _AS_STORED},
        algorithm=row.algorithm,
        package=row.package,
        dataset=row.dataset,
        parameters=parameters,
        playback=Playback(row.playback_mode, row.playback_rate),
        variant=variant_of(row.variant),
        sensors=row.sensors or {},
        asked_version=row.asked_version,
        input_map=None if row.input_map is None else InputMap(**row.input_map),
        protocol_override=None if override is None else protocol_from_content(override),
        protocol=None
        if fingerprint is None
        else ProtocolLabel(fingerprint, with_trajectory(row.protocol_label, row.trajectory)),
        version=_version(row),
        host=None
        if row.cpu_model is None
        else Host(row.cpu_model, row.cpu_count, row.memory_bytes, row.kernel, row.os),
        experiment=row.experiment,
        **options_of_row(row),
        disturbance=None if row.disturbance is None else Disturbance.of(row.disturbance),
        metrics=metrics,
        judged=judged,
        notes=notes,
    )


def _version(row: Row[Any]) -> AlgorithmVersion | None:
    if row.identity is None:
        return None
    return AlgorithmVersion(row.identity, row.package_hash, row.version, row.version_number)


LARGEST_PAGE = 1000
COUNTED = 1_000
"""Matches are counted up to this number; an exact count of more would have to look at all of them."""

_SAMPLE = 300
"""The number of runs that starts are compared on."""
_TRIED = 12
"""At most so many starts are compared on the sample."""


def list_page(
    connection: Connection, search: Search, sort: RunSort, after: str | None, limit: int, *, with_metrics: bool
) -> Page:
    """One page of the runs that match ``search``; see :meth:`RunRepository.page`."""
    if not 1 <= limit <= LARGEST_PAGE:
        raise InvalidInput(f"page size {limit} is not allowed", f"use 1 to {LARGEST_PAGE}")
    found = PageKeys.read(connection, search, sort, after, limit)
    records = {
        record.id: record
        for record in to_records(
            connection,
            connection.execute(run_query(found.protocol_id).where(RunRow.id.in_(found.run_ids))).all(),
            with_metrics=with_metrics,
            protocol_id=found.protocol_id,
        )
    }
    return Page(tuple(records[run_id] for run_id in found.run_ids), found.count, found.next_key)


@dataclass(frozen=True, slots=True)
class PageKeys:
    """The runs of one page, in order. ``protocol_id``: the protocol that the search names, None for none."""

    run_ids: list[int]
    count: Count
    next_key: str | None
    protocol_id: int | None

    @classmethod
    def read(cls, connection: Connection, search: Search, sort: RunSort, after: str | None, limit: int) -> PageKeys:
        """The page after the key ``after``, of at most ``limit`` runs."""
        names = look_up(connection, search, sorted_parameter(connection, sort.key))
        sql = Sql(names)
        order = Order(sort, sql, names_in_order(connection, sort))
        key = None if after is None else decode(after, order.kinds)
        total, rows = Matches(connection, search, sql).page(order, key, limit + 1)
        next_key = encode(rows[limit - 1]) if len(rows) > limit else None
        return cls([row[-1] for row in rows[:limit]], total, next_key, names.protocol_id)


@dataclass(frozen=True)
class Matches:
    """The runs that a search finds.

    A few matches are collected through the most selective index and sorted. If there are many, walking along the order
    of the list soon fills a page. Counting up to :data:`COUNTED` decides which of the two it is.
    """

    connection: Connection
    search: Search
    sql: Sql

    def page(self, order: Order, after: list[Any] | None, limit: int) -> tuple[Count, list[tuple[Any, ...]]]:
        """The number of matches, and up to ``limit`` page keys after ``after``."""
        total, found = self.survey()
        if found is not None:
            runs = RUNS.alias()
            keyed = select(*_labelled(order.columns(runs))).where(among(runs.c.id, found)).subquery()
            keys = list(keyed.c)
            query = select(*keys)
            if after is not None:
                query = query.where(behind(keys, after, descending=order.sort.descending))
            by_value = [keys[0].is_(None)] if len(keys) > 1 else []  # NULLs last, in both directions
            query = query.order_by(*by_value, *ordered(keys, descending=order.sort.descending)).limit(limit)
            return total, [tuple(row) for row in self.connection.execute(query).all()]
        walked: list[tuple[Any, ...]] = []
        for query in order.walk(self.search.tree, after, limit):
            if len(walked) < limit:
                walked += [tuple(row) for row in self.connection.execute(query.limit(limit - len(walked))).all()]
        return total, walked

    def survey(self) -> tuple[Count, Sequence[int] | None]:
        """The number of matches, and their ids if they are few. An index may know the exact number of many."""
        total = self.count_by_index()
        if self.search.tree is None or (total is not None and total.number > COUNTED):
            return total or Count(0), None
        found = self.connection.execute(self.ids(COUNTED + 1)).scalars().all()
        if len(found) > COUNTED:
            return Count(COUNTED, exact=False), None
        return Count(len(found)), found

    def exact_count(self) -> int:
        """The number of matches, however long counting takes."""
        total = self.count_by_index()
        return self._number(self.ids(None).subquery()) if total is None else total.number

    def count_by_index(self) -> Count | None:
        """The exact number if one index knows it: for all runs, and for a single comparison."""
        tree = self.search.tree
        if tree is None:
            return Count(int(self.connection.execute(select(func.count()).select_from(RUNS)).scalar_one()))
        start = next(starts(tree), None) if isinstance(tree, Condition) else None
        if start is None or start.rest is not None or start.also is not None:
            return None
        return Count(self._number(start.ids(self.sql).subquery()))

    def ids(self, limit: int | None) -> Select[Any]:
        """The ids of up to ``limit`` matches, in any order."""
        runs = RUNS.alias()
        found = list(islice(starts(self.search.tree), _TRIED))
        if found:
            start = found[0]
            if len(found) > 1:
                # The cheapest: a sample of runs shows how many each of them yields. It is seeded by the newest run, so
                # that all pages of a list get the same start. Few ids below it are missing.
                newest = self.connection.execute(select(func.max(RUNS.c.id))).scalar_one() or 0
                sample = Random(newest).sample(range(1, newest + 1), min(newest, _SAMPLE))  # noqa: S311 - no secret
                fitting = [func.sum(case((self.sql.test(entry.part, runs), 1), else_=0)) for entry in found]
                lengths = self.connection.execute(select(*fitting).where(among(runs.c.id, sample))).one()
                start = min(zip(found, lengths, strict=True), key=lambda entry: entry[0].cost * (entry[1] or 0))[0]
            return start.matches(self.sql).limit(limit)
        return select(runs.c.id).where(self.sql.test(self.search.tree, runs)).limit(limit)

    def _number(self, rows: FromClause) -> int:
        return int(self.connection.execute(select(func.count()).select_from(rows)).scalar_one())
