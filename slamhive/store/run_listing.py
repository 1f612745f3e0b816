"""Lists of runs: search, sort by any column, metric or parameter, page by key."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import FromClause, Select, func, select
from sqlalchemy.orm import Session

from slamhive.errors import InvalidInput
from slamhive.search.binding import Condition, Search
from slamhive.store.models import Run
from slamhive.store.page_keys import behind, decode, encode, ordered
from slamhive.store.records import Count, Page, RunSort
from slamhive.store.run_order import Order, names_in_order, sorted_parameter
from slamhive.store.run_rows import run_query, to_records
from slamhive.store.search_names import look_up
from slamhive.store.search_sql import RUNS, RunIds, Sql

LARGEST_PAGE = 1000
COUNTED = 2_000
"""Matches are counted up to here; an exact number of more takes as long as looking at all of them."""

_SAMPLE = 5_000


def list_page(
    session: Session, search: Search, sort: RunSort, after: str | None, limit: int, *, with_metrics: bool
) -> Page:
    """One page of the runs that match ``search``; see :meth:`RunRepository.page`."""
    if not 1 <= limit <= LARGEST_PAGE:
        raise InvalidInput(f"page size {limit} is not allowed", f"use 1 to {LARGEST_PAGE}")
    names = look_up(session, search, sorted_parameter(session, sort.key))
    sql = Sql(names)
    order = Order(sort, sql, names_in_order(session, sort))
    key = None if after is None else decode(after, order.kinds)
    matches = Matches(session, search, sql)
    total, rows = matches.page(order, key, limit + 1)
    shown = [row[-1] for row in rows[:limit]]
    records = {
        record.id: record
        for record in to_records(
            session,
            session.execute(run_query(names.protocol_id).where(Run.id.in_(shown))).all(),
            with_metrics=with_metrics,
            protocol_id=names.protocol_id,
        )
    }
    next_key = encode(rows[limit - 1]) if len(rows) > limit else None
    return Page(tuple(records[run_id] for run_id in shown), total, next_key)


@dataclass(frozen=True)
class Matches:
    """The runs that a search finds.

    Few matches are collected through the most selective index and sorted; of many, a walk along the order of the list
    soon finds a page full. Which of the two it is, is counted, not guessed.
    """

    session: Session
    search: Search
    sql: Sql

    def page(self, order: Order, after: list[Any] | None, limit: int) -> tuple[Count, list[tuple[Any, ...]]]:
        """How many there are, and up to ``limit`` page keys from ``after`` on."""
        total = self.count_by_index()
        if self.search.tree is not None and (total is None or total.number <= COUNTED):
            rows, number = self._sorted(order, after, limit)
            if number <= COUNTED:
                return Count(number), rows
        walked: list[tuple[Any, ...]] = []
        for query in order.walk(self.search.tree, after, limit):
            if len(walked) < limit:
                walked += [tuple(row) for row in self.session.execute(query.limit(limit - len(walked)))]
        return total or Count(COUNTED, exact=False), walked

    def count(self) -> Count:
        """How many there are: exact up to ``COUNTED``, and beyond where one index tells."""
        total = self.count_by_index()
        if total is not None:
            return total
        number = self._number(self.ids(COUNTED + 1).subquery())
        return Count(min(number, COUNTED), exact=number <= COUNTED)

    def exact_count(self) -> int:
        """How many there are, however long it takes."""
        total = self.count_by_index()
        return self._number(self.ids(None).subquery()) if total is None else total.number

    def count_by_index(self) -> Count | None:
        """The exact number where a single index knows it: of all runs, and of those that fit one comparison."""
        tree = self.search.tree
        if tree is None:
            return Count(int(self.session.execute(select(func.count()).select_from(RUNS)).scalar_one()))
        starts = self.sql.starts(tree) if isinstance(tree, Condition) else []
        return Count(self._number(starts[0].subquery())) if starts else None

    def ids(self, limit: int | None) -> Select[Any]:
        """The ids of the matches, in no order; ``limit`` of them."""
        runs = RUNS.alias()
        query = select(runs.c.id.label("id"))
        start = self._best_start()
        if start is not None:
            begun = start.subquery()
            query = query.select_from(begun, runs).where(runs.c.id == begun.c.run_id + 0)
        return query.where(self.sql.test(self.search.tree, runs)).limit(limit)

    def _sorted(self, order: Order, after: list[Any] | None, limit: int) -> tuple[list[tuple[Any, ...]], int]:
        """The page if there are few matches, and how many of them there are (``COUNTED`` + 1: too many)."""
        found, runs = self.ids(COUNTED + 1).subquery(), RUNS.alias()
        columns = [column.label(f"key_{place}") for place, column in enumerate(order.columns(runs))]
        keyed = (
            select(*columns, func.count().over().label("number"))
            .select_from(found, runs)
            .where(runs.c.id == found.c.id + 0)
            .subquery()
        )
        keys = list(keyed.c)[:-1]
        query = select(*keyed.c)
        if after is not None:
            query = query.where(behind(keys, after, descending=order.sort.descending))
        by_value = [keys[0].is_(None)] if len(keys) > 1 else []
        query = query.order_by(*by_value, *ordered(keys, descending=order.sort.descending)).limit(limit)
        rows = self.session.execute(query).all()
        if rows:
            return [tuple(row[:-1]) for row in rows], int(rows[0][-1])
        total = self.count()
        return [], total.number if total.exact else COUNTED + 1

    def _best_start(self) -> RunIds | None:
        """The shortest of the lists to begin with; those longer than a sample are not told apart."""
        starts = self.sql.starts(self.search.tree)
        if len(starts) < 2:
            return starts[0] if starts else None
        sampled = [
            select(func.count()).select_from(start.limit(_SAMPLE).subquery()).scalar_subquery() for start in starts
        ]
        lengths = self.session.execute(select(*sampled)).one()
        return starts[min(range(len(starts)), key=lambda place: lengths[place])]

    def _number(self, rows: FromClause) -> int:
        return int(self.session.execute(select(func.count()).select_from(rows)).scalar_one())
