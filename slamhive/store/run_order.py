"""The order of a list of runs, by a column, a metric or a parameter; and queries that walk along it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Column, ColumnElement, Connection, FromClause, Select, Table, and_, literal, select

from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.run import FailureReason, RunState
from slamhive.errors import unknown
from slamhive.search.binding import Bound, Condition
from slamhive.search.fields import PARAMETER_PREFIX, Kind, Source
from slamhive.search.grammar import Junction
from slamhive.search.syntax import PRESENCE
from slamhive.store.models import Algorithm, Configuration, Dataset, Experiment, Run
from slamhive.store.page_keys import behind, ordered
from slamhive.store.records import RunSort
from slamhive.store.search_names import stored_parameters
from slamhive.store.search_sql import NULLABLE, RUNS, Sql

_RUNS: Table = Run.__table__
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
    "algorithm": Algorithm.__table__,
    "dataset": Dataset.__table__,
    "experiment": Experiment.__table__,
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
        """What rows of ``runs`` are sorted by, the run's id last."""
        if self.sort.key == "id":
            return [runs.c.id]
        ties = [runs.c.configuration_id] if self._parameter is not None else []
        return [self._value(runs), *ties, runs.c.id]

    def walk(self, tree: Bound | None, after: list[Any] | None, limit: int) -> list[Select[Any]]:
        """Queries whose rows, one after the other, are the list from ``after`` on: those with a value, then the others.

        Each reads along an index and stops after ``limit``, so it is fast where many runs match.
        """
        missing = [] if self._own(tree) else [self._without_value(tree, after, limit)]
        if after is not None and len(after) > 1 and after[0] is None:
            return missing
        if self.sort.key in CATALOGUE:
            return [self._by_metric(tree, after, limit), *missing]
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
            and (parameter is None or part.field.kind in {Kind.NUMBER, Kind.FLAG})
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

    def _without_value(self, tree: Bound | None, after: list[Any] | None, limit: int) -> Select[Any]:
        runs = RUNS.alias()
        columns = self.columns(runs)
        rest = columns[1:]
        conditions = [self.sql.test(tree, runs), columns[0].is_(None)]
        if after is not None and after[0] is None and rest:
            conditions.append(behind(rest, after[1:], descending=self.sort.descending))
        query = select(*_labelled(columns)).where(*conditions)
        return query.order_by(*ordered(rest or columns, descending=self.sort.descending)).limit(limit)

    def _of_one_name(
        self, tree: Bound | None, number: int, name: str, after: list[Any] | None, limit: int
    ) -> Select[Any] | None:
        """The runs of one algorithm, dataset or experiment, by id; None if an earlier page has shown them all."""
        runs = RUNS.alias()
        conditions = [_is_named(self.sort.key, number, runs), self.sql.test(tree, runs)]
        if after is not None:
            if (name > after[0]) if self.sort.descending else (name < after[0]):
                return None
            if name == after[0]:
                conditions.append(behind([runs.c.id], after[1:], descending=self.sort.descending))
        query = select(*_labelled([literal(name), runs.c.id])).where(*conditions)
        return query.order_by(*ordered([runs.c.id], descending=self.sort.descending)).limit(limit)

    def _by_metric(self, tree: Bound | None, after: list[Any] | None, limit: int) -> Select[Any]:
        runs = RUNS.alias()
        found = self.sql.figures(self.sort.key, by_value=True)
        if found is None:
            return select(*_labelled(self.columns(runs))).where(runs.c.id < 0)
        figures, query = found
        columns = [figures.c.value, figures.c.run_id]
        query = query.where(*(self.sql.compare(figures.c.value, leaf) for leaf in self._own(tree)))
        pairs: Select[Any] = query.with_only_columns(*_labelled(columns)).select_from(figures, runs)
        pairs = pairs.where(runs.c.id == figures.c.run_id + 0, self.sql.test(tree, runs), *self._from(columns, after))
        return pairs.order_by(*ordered(columns, descending=self.sort.descending)).limit(limit)

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


def _is_named(key: str, number: int, runs: FromClause) -> ColumnElement[bool]:
    if key == "experiment":
        return runs.c.experiment_id == number
    rows = Configuration.__table__.alias()
    query = select(literal(1)).where(rows.c.id == runs.c.configuration_id, rows.c[f"{key}_id"] + 0 == number)
    return query.limit(1).scalar_subquery() == 1


def _name_of(key: str, runs: FromClause) -> ColumnElement[Any]:
    table = _TABLES[key].alias()
    if key == "experiment":
        return select(table.c.name).where(table.c.id == runs.c.experiment_id).scalar_subquery()
    rows = Configuration.__table__.alias()
    query = select(table.c.name).where(rows.c.id == runs.c.configuration_id, table.c.id == rows.c[f"{key}_id"])
    return query.scalar_subquery()
