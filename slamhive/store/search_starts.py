"""Lists of runs to begin a search with: each is read through an index and holds every run that matches."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, select, union

from slamhive.search.binding import Bound, Condition
from slamhive.search.fields import Source
from slamhive.search.grammar import Junction, join, leaves
from slamhive.search.syntax import Sign
from slamhive.store.search_sql import COMPLEMENTS, NEVER, RUNS, Sql
from slamhive.store.search_verdicts import verdict_tree

_INDEXED = frozenset(
    {"id", "state", "reason", "executor", "configuration", "experiment", "created_at", "ended_at", "disturbed"}
)
_OF_CONFIGURATIONS = frozenset({Source.CONFIGURATION, Source.SETUP, Source.PARAMETER})
_LOOK_UP = 3
"""Reading a run's own row costs about so many times what testing a metric does."""


@dataclass(frozen=True)
class Start:
    """A list to begin with, each run once.

    ``part`` is what its runs fit: a comparison, or an ``or`` of what can be started with. ``more`` is tested of the
    configurations before their runs are read, ``rest`` of the runs; None: nothing.
    """

    part: Bound
    rest: Bound | None = None
    more: Bound | None = None

    @property
    def cost(self) -> int:
        """What testing a run costs, beside others."""
        return _LOOK_UP if self._needs_run else 1

    def ids(self, sql: Sql) -> Select[Any]:
        """The runs of the list, as ``id``."""
        rows = self._rows(sql)
        return rows.with_only_columns(rows.selected_columns.id)

    def matches(self, sql: Sql) -> Select[Any]:
        """The ids of the runs that match. Metrics are tested before a run's own row is looked up, if it has to be."""
        rows = self._rows(sql)
        runs = rows.subquery()
        if self._needs_run and len(rows.selected_columns) == 1:
            found, own = runs, RUNS.alias()
            others = [column for column in own.c if column.key != "id"]
            runs = select(found.c.id, *others).where(own.c.id == found.c.id + 0).subquery()
        return select(runs.c.id).where(sql.test(self.rest, runs))

    @property
    def _needs_run(self) -> bool:
        return self.rest is not None and not _among(self.rest, {Source.METRIC})

    def _rows(self, sql: Sql) -> Select[Any]:
        """The list with all columns of ``RUNS`` where they come with it, otherwise with ``id`` alone."""
        leaf, runs = self.part, RUNS.alias()
        if isinstance(leaf, Junction):
            return select(union(*(next(starts(part)).ids(sql) for part in leaf.parts)).subquery())
        if leaf.field.source is Source.METRIC:
            found = sql.figures_where(leaf, by_value=True)
            if found is None:
                return select(runs.c.id).where(NEVER)
            return found[1].with_only_columns(found[0].c.run_id.label("id"))
        query = select(*runs.c)
        if leaf.field.source is Source.RUN:
            return query.where(sql.on_run(leaf, runs, guarded=False))
        fitting = sql.configurations_where(leaf).subquery()
        chosen = select(fitting.c.configuration_id).where(sql.test(self.more, fitting)).subquery()
        return query.where(runs.c.configuration_id == chosen.c.configuration_id + 0)


def starts(tree: Bound | None) -> Iterator[Start]:
    """The lists that there are; none if there is no way.

    One part of an ``and`` is enough; an ``or`` needs all its parts together.
    """
    if isinstance(tree, Condition):
        if tree.field.source is Source.VERDICT and tree.sign is not Sign.MISSING:
            yield from starts(verdict_tree(tree))
        elif _has_list(tree):
            yield Start(tree)
    elif tree is not None and tree.word == "and":
        yield from _starts_of_and(tree.parts)
    elif tree is not None and tree.word == "or":
        firsts = [next(starts(part), None) for part in tree.parts]
        if None not in firsts:
            exact = all(start is not None and start.rest is None for start in firsts)
            yield Start(tree, rest=None if exact else tree)


def _starts_of_and(parts: Sequence[Bound]) -> Iterator[Start]:
    """Apply conditions on configurations before their runs are read, if the search starts with one of them."""
    shared = [_among(part, _OF_CONFIGURATIONS) for part in parts]
    of_runs = _all([part for part, is_shared in zip(parts, shared, strict=True) if not is_shared])
    for place, part in enumerate(parts):
        others = [*parts[:place], *parts[place + 1 :]]
        if isinstance(part, Condition) and shared[place]:
            if _has_list(part):
                of_configurations = [other for at, other in enumerate(parts) if shared[at] and at != place]
                yield Start(part, rest=of_runs, more=_all(of_configurations))
        else:
            for start in starts(part):
                yield Start(start.part, rest=_all([start.rest, *others]), more=start.more)


def _has_list(leaf: Condition) -> bool:
    if leaf.field.source is Source.METRIC:
        return leaf.sign is not Sign.MISSING
    if leaf.sign in COMPLEMENTS:
        return False
    return leaf.field.source is not Source.RUN or (leaf.field.name in _INDEXED and leaf.sign is not Sign.HAS)


def _among(tree: Bound, sources: Collection[Source]) -> bool:
    return all(leaf.field.source in sources for leaf in leaves(tree))


def _all(parts: Sequence[Bound | None]) -> Bound | None:
    there = [part for part in parts if part is not None]
    return join("and", there) if there else None
