"""Where a search can start: lists of runs that an index yields and that contain every match."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, select, union

from slamhive.search.binding import Bound, Condition
from slamhive.search.fields import Source
from slamhive.search.grammar import Junction, join, leaves
from slamhive.search.syntax import Sign
from slamhive.store.search_notes import noted
from slamhive.store.search_sql import COMPLEMENTS, DERIVED, NEVER, RUNS, Sql

_INDEXED = frozenset(
    {
        "id",
        "state",
        "reason",
        "executor",
        "owner",
        "configuration",
        "experiment",
        "created_at",
        "ended_at",
        "disturbed",
        "version",
    }
)
_OF_CONFIGURATIONS = frozenset({Source.CONFIGURATION, Source.SETUP, Source.ATTRIBUTE, Source.PARAMETER})
_LOOK_UP = 3
"""Reading the row of a run costs about this many times what testing a metric does."""


@dataclass(frozen=True)
class Start:
    """A list to start with, each run once.

    Attributes:
        part: What its runs fulfil: a comparison, or an ``or`` of comparisons that an index serves.
        rest: What is still to be tested of its runs; None is nothing.
        also: What its configurations fulfil besides ``part``, tested before their runs are read; None is nothing.
    """

    part: Bound
    rest: Bound | None = None
    also: Bound | None = None

    @property
    def cost(self) -> int:
        """What it costs to test one run, compared with other starts."""
        return _LOOK_UP if self._needs_run else 1

    def ids(self, sql: Sql) -> Select[Any]:
        """The runs of the list, as ``id``."""
        rows = self._rows(sql)
        return rows.with_only_columns(rows.selected_columns.id)

    def matches(self, sql: Sql) -> Select[Any]:
        """The ids of the runs that match. The row of a run is only looked up if a test needs it."""
        rows = self._rows(sql)
        runs = rows.subquery()
        if self._needs_run and len(rows.selected_columns) == 1:
            found, own = runs, RUNS.alias()
            others = [column for column in own.c if column.key != "id"]
            runs = select(found.c.id, *others).where(own.c.id == found.c.id + 0).subquery()
        return select(runs.c.id).where(sql.test(self.rest, runs))

    @property
    def _needs_run(self) -> bool:
        return self.rest is not None and any(leaf.field.source is not Source.METRIC for leaf in leaves(self.rest))

    def _rows(self, sql: Sql) -> Select[Any]:
        """The list: with all columns of ``RUNS`` where they come for free, otherwise with ``id`` alone."""
        leaf, runs = self.part, RUNS.alias()
        if isinstance(leaf, Junction):
            return select(union(*(next(starts(part)).ids(sql) for part in leaf.parts)).subquery())
        if leaf.field.source is Source.METRIC:
            found = sql.figures_where(leaf, by_value=True)
            if found is None:
                return select(runs.c.id).where(NEVER)
            return found[1].with_only_columns(found[0].c.run_id.label("id"))
        if leaf.field.source is Source.NOTE:
            rows, query = noted(leaf, sql.compare)
            return query.with_only_columns(rows.c.run_id.label("id")).distinct()
        query = select(*runs.c)
        if leaf.field.source is Source.RUN:
            return query.where(sql.on_run(leaf, runs, guarded=False))
        fitting = sql.configurations_where(leaf).subquery()
        chosen = select(fitting.c.configuration_id).where(sql.test(self.also, fitting)).subquery()
        return query.where(runs.c.configuration_id == chosen.c.configuration_id + 0)


def starts(tree: Bound | None) -> Iterator[Start]:
    """The lists that a search can start with. One part of an ``and`` is enough; an ``or`` needs all its parts."""
    if isinstance(tree, Condition):
        derived = DERIVED.get(tree.field.source)
        if derived is not None and tree.sign is not Sign.MISSING:
            yield from starts(derived(tree))
        elif _has_index(tree):
            yield Start(tree)
    elif tree is not None and tree.word == "and":
        for place, part in enumerate(tree.parts):
            yield from _starts_of_part(part, [*tree.parts[:place], *tree.parts[place + 1 :]])
    elif tree is not None and tree.word == "or":
        firsts = [next(starts(part), None) for part in tree.parts]
        if None not in firsts:
            exact = all(start is not None and start.rest is None for start in firsts)
            yield Start(tree, rest=None if exact else tree)


def _starts_of_part(part: Bound, others: Sequence[Bound]) -> Iterator[Start]:
    """The lists that one part of an ``and`` yields, with what the ``others`` leave to be tested."""
    shared = [other for other in others if _of_configuration(other)] if _of_configuration(part) else []
    rest = [other for other in others if other not in shared]
    for start in starts(part):
        yield Start(start.part, _all_of([start.rest, *rest]), _all_of([start.also, *shared]))


def _of_configuration(part: Bound) -> bool:
    return isinstance(part, Condition) and part.field.source in _OF_CONFIGURATIONS


def _has_index(leaf: Condition) -> bool:
    if leaf.field.source is Source.METRIC:
        return leaf.sign is not Sign.MISSING
    if leaf.sign in COMPLEMENTS:
        return False
    return leaf.field.source is not Source.RUN or (leaf.field.name in _INDEXED and leaf.sign is not Sign.HAS)


def _all_of(parts: Sequence[Bound | None]) -> Bound | None:
    there = [part for part in parts if part is not None]
    return join("and", there) if there else None
