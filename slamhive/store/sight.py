"""Hides rows from a viewer: no answer of the database contains a row that the viewer may not see.

A connection that reads for a viewer adds a condition to each SELECT, also to those inside others, while SQLAlchemy
turns it into text. So no query has to think of viewers, and none can forget them. Where nothing is hidden, nothing is
added.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from typing import Any

from sqlalchemy import (
    Alias,
    ColumnElement,
    CompoundSelect,
    Connection,
    FromClause,
    Join,
    Select,
    TableClause,
    and_,
    bindparam,
    event,
    func,
    or_,
    select,
)
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import count
from sqlalchemy.util import LRUCache

from slamhive.domain.accounts import ANYBODY, Viewer
from slamhive.store.models import AnalysisRow, ExperimentRow, RunRow

SEEN = {"runs": RunRow.__table__, "experiments": ExperimentRow.__table__, "analyses": AnalysisRow.__table__}
"""The tables whose rows have an audience."""
OF_RUNS = ("metric_values", "run_notes", "run_tags", "run_events", "evaluations")
"""Tables whose rows belong to a run, their ``run_id``."""
OF_EXPERIMENTS = ("experiment_cells",)
"""Tables whose rows belong to an experiment, their ``experiment_id``."""
_STATEMENTS = 500
_AS_IT_IS = "slamhive_as_it_is"
"""Option of a SELECT that gets no condition."""


@dataclass
class _Sight:
    """The eyes of one connection: which tables hold hidden rows, and the statement that is being executed."""

    viewer: Viewer
    hidden: frozenset[str]
    statement: Any = None
    within: list[frozenset[str]] = field(default_factory=list)
    """The tables of the SELECTs around the one that is being compiled."""

    def before(self, _connection: Connection, statement: Any, several: Any, one: Any, _options: Any) -> Any:
        """Have the conditions added when ``statement`` is compiled."""
        if isinstance(statement, Select | CompoundSelect):
            # A copy: only this execution of the statement is meant.
            self.statement = statement = statement.execution_options(slamhive_viewer=True)
            _ACTIVE.set(self)
        return statement, several, one

    def conditions(self, query: Select[Any]) -> tuple[frozenset[str], list[ColumnElement[bool]]]:
        """The tables that ``query`` reads, and what hides rows of them."""
        read = [(part, outer) for source in self._sources(query) for part, outer in _tables(source)]
        names = frozenset(_name(part) for part, _ in read)
        counts = query.whereclause is None and any(isinstance(part, count) for part in query.selected_columns)
        around = names.union(*self.within)
        found = []
        for part, outer in read:
            name, condition = _name(part), None
            if name == "experiments" and "runs" in names:
                continue  # who sees a run sees its experiment
            if name in self.hidden:
                condition = _seen(part, signed_in=self.viewer.signed_in, counts=counts)
            elif name in OF_RUNS and "runs" in self.hidden and "runs" not in around:
                condition = part.c.run_id.not_in(_hidden_rows("runs", signed_in=self.viewer.signed_in))
            elif name in OF_EXPERIMENTS and "experiments" in self.hidden and "experiments" not in around:
                condition = part.c.experiment_id.not_in(_hidden_rows("experiments", signed_in=self.viewer.signed_in))
            if condition is not None:
                found.append(or_(next(iter(part.primary_key or part.c)).is_(None), condition) if outer else condition)
        return names, found

    def _sources(self, query: Select[Any]) -> Sequence[FromClause]:
        """The tables and joins that ``query`` selects from. SQLAlchemy compiles it for this, which must add nothing."""
        self.statement, statement = None, self.statement
        try:
            return query.get_final_froms()
        finally:
            self.statement = statement


_ACTIVE: ContextVar[_Sight | None] = ContextVar("slamhive_sight", default=None)
_COMPILED: dict[tuple[bool, frozenset[str]], Any] = {}
"""Compiled statements. They differ between viewers in values only, which are asked for at each execution."""


def restrict(connection: Connection, viewer: Viewer | None) -> None:
    """Let ``connection`` see no more than ``viewer`` until its transaction ends; None sees everything."""
    if viewer is None:
        return
    sight = _Sight(viewer, frozenset())
    _ACTIVE.set(sight)
    found = connection.execute(_anything_hidden(signed_in=viewer.signed_in)).one()
    hidden = frozenset(name for name, there in zip(SEEN, found, strict=True) if there)
    if hidden:
        sight.hidden = hidden
        kept = _COMPILED.setdefault((viewer.signed_in, hidden), LRUCache(_STATEMENTS))
        connection.execution_options(compiled_cache=kept)
        event.listen(connection, "before_execute", sight.before, retval=True)


def seeing_all(query: Select[Any]) -> Select[Any]:
    """``query`` without conditions, for what must hold for all rows, such as that a name is unique."""
    return query.execution_options(**{_AS_IT_IS: True})


def _seen(rows: FromClause, *, signed_in: bool, counts: bool) -> ColumnElement[bool]:
    """Tell if the viewer sees a row.

    An index serves it only where all rows are counted: databases would sort others instead of walking along an order.
    """
    audience = rows.c.audience if counts else func.coalesce(rows.c.audience, "")
    found: ColumnElement[bool] = audience.in_(_audiences(signed_in=signed_in))
    return found


@compiles(Select)
def _compile(query: Select[Any], compiler: Any, **options: Any) -> str:
    sight = _ACTIVE.get()
    if sight is None or sight.statement is not compiler.statement or query.get_execution_options().get(_AS_IT_IS):
        return str(compiler.visit_select(query, **options))
    names, conditions = sight.conditions(query)
    sight.within.append(names)
    try:
        return str(compiler.visit_select(query.where(*conditions) if conditions else query, **options))
    finally:
        sight.within.pop()


def _tables(source: FromClause, *, outer: bool = False) -> Iterator[tuple[FromClause, bool]]:
    """The tables in a FROM, and whether rows of them may be missing (outer joins)."""
    if isinstance(source, Join):
        yield from _tables(source.left, outer=outer)
        yield from _tables(source.right, outer=outer or source.isouter)
    elif _name(source):
        yield source, outer


def _name(source: FromClause) -> str:
    """The name of a table, also under an alias; empty for what is none."""
    named = source.element if isinstance(source, Alias) else source
    return named.name if isinstance(named, TableClause) else ""


def _audiences(*, signed_in: bool) -> list[ColumnElement[str]]:
    """The audiences of the viewer, sorted. Each execution takes them from the viewer of its connection."""

    def value(place: int) -> Callable[[], str]:
        return lambda: _viewer().audiences[place]

    kind = RunRow.__table__.c.audience.type
    return [bindparam(None, callable_=value(place), type_=kind) for place in range(3 if signed_in else 1)]


def _viewer() -> Viewer:
    sight = _ACTIVE.get()
    return ANYBODY if sight is None else sight.viewer


def _hidden(rows: FromClause, *, signed_in: bool) -> ColumnElement[bool]:
    """Tell if a row is hidden: an index finds such rows between the audiences of the viewer."""
    mine, audience = _audiences(signed_in=signed_in), rows.c.audience
    between = [and_(audience > low, audience < high) for low, high in pairwise(mine)]
    return or_(audience < mine[0], *between, audience > mine[-1])


def _hidden_rows(table: str, *, signed_in: bool) -> Select[Any]:
    rows = SEEN[table].alias()
    return seeing_all(select(rows.c.id).where(_hidden(rows, signed_in=signed_in)))


@cache
def _anything_hidden(*, signed_in: bool) -> Any:
    """For each table of :data:`SEEN`, whether it holds hidden rows."""
    return select(*(_hidden_rows(name, signed_in=signed_in).limit(1).exists() for name in SEEN))
