"""Lists of runs to begin a search with: each is read through an index and holds every run that matches."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import Select, select, union

from slamhive.search.binding import Bound, Condition
from slamhive.search.fields import Source
from slamhive.search.grammar import Junction, join, leaves
from slamhive.search.syntax import Sign
from slamhive.store.search_sql import COMPLEMENTS, NEVER, RUNS, Sql

_INDEXED = frozenset({"id", "state", "reason", "executor", "configuration", "experiment", "created_at", "ended_at"})


_OF_CONFIGURATIONS = frozenset({Source.CONFIGURATION, Source.SETUP, Source.PARAMETER})
_LOOK_UP = 3
"""Reading a run's own row costs about so many times what testing a figure does."""


@dataclass(frozen=True)
class Start:
    """A list to begin with, each run once: those that fit ``part``, and what is left to test of them (None: nothing).

    ``rows`` has the columns of ``RUNS`` where ``whole``, otherwise only ``id``.
    """

    rows: Select[Any]
    part: Bound
    whole: bool
    rest: Bound | None = None

    @property
    def ids(self) -> Select[Any]:
        """The runs of the list."""
        return self.rows.with_only_columns(self.rows.selected_columns.id)

    @property
    def cost(self) -> int:
        """What testing a run costs, beside others."""
        return _LOOK_UP if self._needs_run else 1

    def matches(self, sql: Sql) -> Select[Any]:
        """The ids of the runs that match. Figures are tested before a run's own row is looked up, if it has to be."""
        runs = self.rows.subquery()
        if self._needs_run and not self.whole:
            found, own = runs, RUNS.alias()
            more = [column for column in own.c if column.key != "id"]
            runs = select(found.c.id, *more).where(own.c.id == found.c.id + 0).subquery()
        return select(runs.c.id).where(sql.test(self.rest, runs))

    @property
    def _needs_run(self) -> bool:
        return self.rest is not None and not _among(self.rest, {Source.METRIC})


def starts(sql: Sql, tree: Bound | None) -> list[Start]:
    """The lists that there are; none if there is no way.

    One part of an ``and`` is enough; an ``or`` needs all its parts together.
    """
    if tree is None:
        return []
    if not isinstance(tree, Junction):
        one = _start_one(sql, tree)
        return [] if one is None else [one]
    if tree.word == "and":
        return [start for place in range(len(tree.parts)) for start in _starts_of_part(sql, tree.parts, place)]
    parts = [starts(sql, part) for part in tree.parts]
    if tree.word == "or" and all(parts):
        firsts = [part[0] for part in parts]
        ids = [select(start.rows.subquery().c.id) for start in firsts]
        exact = all(start.rest is None for start in firsts)
        return [Start(select(union(*ids).subquery()), tree, whole=False, rest=None if exact else tree)]
    return []


def _starts_of_part(sql: Sql, parts: Sequence[Bound], place: int) -> list[Start]:
    """The lists that one part of an ``and`` gives. What restricts configurations does so before their runs are read."""
    part, others = parts[place], [*parts[:place], *parts[place + 1 :]]
    if isinstance(part, Condition) and part.field.source in _OF_CONFIGURATIONS:
        shared = [other for other in others if _among(other, _OF_CONFIGURATIONS)]
        one = _start_one(sql, part, _all(shared))
        return [] if one is None else [replace(one, rest=_all([other for other in others if other not in shared]))]
    return [replace(start, rest=_all([start.rest, *others])) for start in starts(sql, part)]


def _start_one(sql: Sql, leaf: Condition, more: Bound | None = None) -> Start | None:
    """The list of one comparison; ``more`` is tested of the configurations if it is one of those."""
    source = leaf.field.source
    runs = RUNS.alias()
    if source is Source.METRIC and leaf.sign is not Sign.MISSING:
        found = sql.figures_where(leaf, by_value=True)
        if found is None:
            return Start(select(runs.c.id).where(NEVER), leaf, whole=False)
        return Start(found[1].with_only_columns(found[0].c.run_id.label("id")), leaf, whole=False)
    if leaf.sign in COMPLEMENTS:
        return None
    query = select(*runs.c)
    if source is Source.RUN:
        usable = leaf.field.name in _INDEXED and leaf.sign is not Sign.HAS
        return Start(query.where(sql.on_run(leaf, runs, guarded=False)), leaf, whole=True) if usable else None
    fitting = sql.configurations_where(leaf).subquery()
    chosen = select(fitting.c.configuration_id).where(sql.test(more, fitting)).subquery()
    return Start(query.where(runs.c.configuration_id == chosen.c.configuration_id + 0), leaf, whole=True)


def _among(tree: Bound, sources: Collection[Source]) -> bool:
    return all(leaf.field.source in sources for leaf in leaves(tree))


def _all(parts: Sequence[Bound | None]) -> Bound | None:
    there = [part for part in parts if part is not None]
    return join("and", there) if there else None
