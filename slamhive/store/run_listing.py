"""Lists of runs: search, sort by any column, metric or parameter, page by key."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from random import Random
from typing import Any

from sqlalchemy import ColumnElement, Connection, FromClause, Select, bindparam, case, func, select

from slamhive.errors import InvalidInput
from slamhive.search.binding import Condition, Search
from slamhive.store.models import Run
from slamhive.store.page_keys import behind, decode, encode, ordered
from slamhive.store.records import Count, Page, RunSort
from slamhive.store.run_order import Order, names_in_order, sorted_parameter
from slamhive.store.run_rows import run_query, to_records
from slamhive.store.search_names import look_up
from slamhive.store.search_sql import RUNS, Sql
from slamhive.store.search_starts import Start, starts

LARGEST_PAGE = 1000
COUNTED = 1_000
"""Matches are counted up to this number; an exact count of more would have to look at all of them."""

_SAMPLE = 300
_TRIED = 12
"""At most so many starts are compared on the sample."""


def list_page(
    connection: Connection, search: Search, sort: RunSort, after: str | None, limit: int, *, with_metrics: bool
) -> Page:
    """One page of the runs that match ``search``; see :meth:`RunRepository.page`."""
    if not 1 <= limit <= LARGEST_PAGE:
        raise InvalidInput(f"page size {limit} is not allowed", f"use 1 to {LARGEST_PAGE}")
    names = look_up(connection, search, sorted_parameter(connection, sort.key))
    sql = Sql(names)
    order = Order(sort, sql, names_in_order(connection, sort))
    key = None if after is None else decode(after, order.kinds)
    matches = Matches(connection, search, sql)
    total, rows = matches.page(order, key, limit + 1)
    shown = [row[-1] for row in rows[:limit]]
    records = {
        record.id: record
        for record in to_records(
            connection,
            connection.execute(run_query(names.protocol_id).where(Run.id.in_(shown))).all(),
            with_metrics=with_metrics,
            protocol_id=names.protocol_id,
        )
    }
    next_key = encode(rows[limit - 1]) if len(rows) > limit else None
    return Page(tuple(records[run_id] for run_id in shown), total, next_key)


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
        """How many runs match, and up to ``limit`` page keys after ``after``."""
        total, found = self.survey()
        if found is not None:
            return total, self._sorted(found, order, after, limit)
        walked: list[tuple[Any, ...]] = []
        for query in order.walk(self.search.tree, after, limit):
            if len(walked) < limit:
                walked += [tuple(row) for row in self.connection.execute(query.limit(limit - len(walked)))]
        return total, walked

    def survey(self) -> tuple[Count, Sequence[int] | None]:
        """How many runs match, and their ids if they are few. An index may know the exact number of many."""
        total = self.count_by_index()
        if self.search.tree is None or (total is not None and total.number > COUNTED):
            return total or Count(0), None
        found = self.connection.execute(self.ids(COUNTED + 1)).scalars().all()
        if len(found) > COUNTED:
            return Count(COUNTED, exact=False), None
        return Count(len(found)), found

    def exact_count(self) -> int:
        """How many runs match, however long counting takes."""
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
        start = self._best_start()
        if start is not None:
            return start.matches(self.sql).limit(limit)
        runs = RUNS.alias()
        return select(runs.c.id).where(self.sql.test(self.search.tree, runs)).limit(limit)

    def _sorted(self, found: Sequence[int], order: Order, after: list[Any] | None, limit: int) -> list[tuple[Any, ...]]:
        """The page among these runs."""
        runs = RUNS.alias()
        columns = [column.label(f"key_{place}") for place, column in enumerate(order.columns(runs))]
        keyed = select(*columns).where(among(runs.c.id, found)).subquery()
        keys = list(keyed.c)
        query = select(*keys)
        if after is not None:
            query = query.where(behind(keys, after, descending=order.sort.descending))
        by_value = [keys[0].is_(None)] if len(keys) > 1 else []
        query = query.order_by(*by_value, *ordered(keys, descending=order.sort.descending)).limit(limit)
        return [tuple(row) for row in self.connection.execute(query)]

    def _best_start(self) -> Start | None:
        """The cheapest start. A sample of runs shows how many runs each of them yields."""
        found = list(islice(starts(self.search.tree), _TRIED))
        if len(found) < 2:
            return found[0] if found else None
        newest = self.connection.execute(select(func.max(RUNS.c.id))).scalar_one() or 0
        sample = Random(newest).sample(range(1, newest + 1), min(newest, _SAMPLE))  # noqa: S311 - no secret
        runs = RUNS.alias()
        fitting = [func.sum(case((self.sql.test(start.part, runs), 1), else_=0)) for start in found]
        lengths = self.connection.execute(select(*fitting).where(among(runs.c.id, sample))).one()
        return min(zip(found, lengths, strict=True), key=lambda entry: entry[0].cost * (entry[1] or 0))[0]

    def _number(self, rows: FromClause) -> int:
        return int(self.connection.execute(select(func.count()).select_from(rows)).scalar_one())


def among(column: ColumnElement[int], ids: Sequence[int]) -> ColumnElement[bool]:
    """Whether it is one of ``ids``. They become part of the statement: drivers limit the number of parameters."""
    return column.in_(bindparam(None, list(ids), expanding=True, literal_execute=True))
