"""Conditions of a search as SQL: a test of one run, and the rows behind one comparison.

The way a condition is written decides which index both databases use: ``column + 0`` forbids an index. A query thus
keeps its plan even if the statistics of the tables are old.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from sqlalchemy import (
    ColumnElement,
    FromClause,
    Select,
    TableClause,
    and_,
    case,
    column,
    false,
    func,
    literal,
    not_,
    or_,
    select,
    table,
    true,
)

from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.run import RunState
from slamhive.domain.visibility import Visibility
from slamhive.search.binding import Bound, Condition, Value, members_of
from slamhive.search.fields import VARIANT_PREFIX, Kind, Source
from slamhive.search.grammar import Junction
from slamhive.search.syntax import PRESENCE, Sign
from slamhive.store.metrics import VERDICT
from slamhive.store.models import (
    Algorithm,
    AlgorithmVersion,
    Configuration,
    ConfigurationValue,
    Dataset,
    Experiment,
    MetricValue,
    Run,
    VariantOption,
)
from slamhive.store.search_names import Names
from slamhive.store.search_notes import OPPOSITE, noted
from slamhive.store.search_trust import trust_tree
from slamhive.store.search_verdicts import STORED_FAILURE, verdict_tree
from slamhive.store.tables import Base

_RUN_COLUMNS = {
    "configuration": "configuration_id",
    "experiment": "experiment_id",
    "evaluated": "current_protocol_id",
    "disturbed": "disturbed_by",
    "version": "algorithm_version_id",
    "visibility": "audience",
}
SEARCHED = (
    *("id", "configuration_id", "experiment_id", "current_protocol_id", "executor", "state", "reason", "seed"),
    *("priority", "exit_code", "created_at", "started_at", "ended_at", "disturbed_by", "trajectory"),
    *("algorithm_version_id", "owner", "audience"),
)


def _plain(model: type[Base], *names: str) -> TableClause:
    """The columns that searches need: an alias of the whole model takes longer to make than many queries take."""
    return table(model.__tablename__, *(column(name, model.__table__.c[name].type) for name in names))


RUNS = _plain(Run, *SEARCHED)
FIGURES = _plain(MetricValue, "metric_id", "run_id", "protocol_id", "value", "is_current")
NULLABLE = frozenset(name for name in SEARCHED if Run.__table__.c[name].nullable)
_NAMED = {"experiment": Experiment.__table__.c.name, "version": AlgorithmVersion.__table__.c.number}
"""Columns of runs that hold an id; what is compared is in its row."""

_GUARDED = NULLABLE | {"state"}
"""With an index on the state, databases would sort all matches instead of walking along the order of a list."""

NEVER = literal(0) == 1
"""``false()`` would be folded, together with the condition that joins two tables."""

DERIVED: dict[Source, Callable[[Condition], Bound]] = {Source.VERDICT: verdict_tree, Source.TRUST: trust_tree}
"""The conditions behind comparisons of what follows from other values."""

COMPLEMENTS = frozenset({Sign.NOT_EQUAL, Sign.NOT_IN, Sign.UNLIKE, Sign.MISSING})
_COMPARE: dict[Sign, Callable[[Any, Any], ColumnElement[bool]]] = {
    Sign.EQUAL: lambda column, value: column == value,
    Sign.NOT_EQUAL: lambda column, value: column != value,
    Sign.LESS: lambda column, value: column < value,
    Sign.AT_MOST: lambda column, value: column <= value,
    Sign.MORE: lambda column, value: column > value,
    Sign.AT_LEAST: lambda column, value: column >= value,
}


class Sql:
    """The conditions of one search."""

    def __init__(self, names: Names) -> None:
        self._names = names

    # -- a test of one run -----------------------------------------------------------------------------------------

    def test(self, tree: Bound | None, runs: FromClause) -> ColumnElement[bool]:
        """Whether a row of ``runs`` matches; never NULL."""
        if tree is None:
            return true()
        if not isinstance(tree, Junction):
            return self._test_one(tree, runs)
        parts = [self.test(part, runs) for part in tree.parts]
        if tree.word == "not":
            return not_(parts[0])
        return or_(*parts) if tree.word == "or" else and_(*parts)

    def _test_one(self, leaf: Condition, runs: FromClause) -> ColumnElement[bool]:
        if leaf.sign is Sign.MISSING:
            return not_(self._test_one(Condition(leaf.field, Sign.HAS), runs))
        source = leaf.field.source
        if source in DERIVED:
            return self.test(DERIVED[source](leaf), runs)
        own: dict[Source, Callable[[Condition, FromClause], ColumnElement[bool]]] = {
            Source.RUN: self.on_run,
            Source.METRIC: self._on_metric,
            Source.PARAMETER: self._on_parameter,
            Source.NOTE: self._on_notes,
        }
        return own.get(source, self._on_configurations)(leaf, runs)

    def _on_metric(self, leaf: Condition, runs: FromClause) -> ColumnElement[bool]:
        found = self.figures_where(leaf, by_value=False)
        return NEVER if found is None else _any(found[1].where(found[0].c.run_id == runs.c.id))

    def _on_parameter(self, leaf: Condition, runs: FromClause) -> ColumnElement[bool]:
        values, query = self._parameter_values(leaf, by_value=False)
        return _any(query.where(values.c.configuration_id == runs.c.configuration_id))

    def _on_configurations(self, leaf: Condition, runs: FromClause) -> ColumnElement[bool]:
        rows, query = self._configurations(leaf)
        return _any(query.where(rows.c.id == runs.c.configuration_id))

    def _on_notes(self, leaf: Condition, runs: FromClause) -> ColumnElement[bool]:
        """A comparison with the note or the tags. A run fulfils ``!=`` if none of its tags equals the value."""
        rows, query = noted(replace(leaf, sign=OPPOSITE.get(leaf.sign, leaf.sign)), self.compare)
        found = _any(query.where(rows.c.run_id == runs.c.id))
        return not_(found) if leaf.sign in OPPOSITE else found

    def on_run(self, leaf: Condition, runs: FromClause, *, guarded: bool = True) -> ColumnElement[bool]:
        """A condition on a column. If ``guarded`` it is never NULL and uses no index."""
        name = _RUN_COLUMNS.get(leaf.field.name, leaf.field.name)
        value = runs.c[name]
        if leaf.field.name == "disturbed_by":
            return func.coalesce(_disturbed_by(value, leaf), false())
        if leaf.sign is Sign.HAS:
            return value.is_not(None)
        if leaf.field.name == "visibility":
            return self.compare(_visibility(runs.c.audience), leaf)
        if leaf.field.name == "disturbed":
            disturbed = leaf.values[0] is (leaf.sign is Sign.EQUAL)
            known = value > "" if disturbed else value == ""
            return func.coalesce(known, false()) if guarded else known
        if leaf.field.name == "evaluated":
            evaluated = leaf.values[0] is (leaf.sign is Sign.EQUAL)
            return value.is_not(None) if evaluated else value.is_(None)
        if leaf.field.name in _NAMED:
            row = _NAMED[leaf.field.name]
            found: ColumnElement[bool] = value.in_(select(row.table.c.id).where(self.compare(row, leaf)))
        else:
            found = self.compare(value, leaf)
        return func.coalesce(found, false()) if guarded and name in _GUARDED else found

    def failed(self, runs: FromClause) -> ColumnElement[bool]:
        """Whether a row of ``runs`` counts as failed, by its end or by its verdict."""
        ended_badly: ColumnElement[bool] = runs.c.state == RunState.FAILED
        found = self.figures_where(STORED_FAILURE, by_value=True)
        if found is None:
            return ended_badly
        return or_(ended_badly, runs.c.id.in_(found[1].with_only_columns(found[0].c.run_id)))

    # -- where values are ------------------------------------------------------------------------------------------

    def figures(self, key: str, *, by_value: bool) -> tuple[FromClause, Select[Any]] | None:
        """The rows of one metric under the chosen protocol, at most one for each run; None if no run has the metric.

        ``by_value`` reads them through the index that is sorted by value; otherwise they are read run by run.
        """
        if key not in self._names.metrics:
            return None
        rows = FIGURES.alias()
        query = select(literal(1)).select_from(rows).where(rows.c.metric_id == self._names.metrics[key])
        chosen = self._names.protocol_id
        if chosen is None or not (key == VERDICT or CATALOGUE[key].needs_protocol):
            return rows, query.where((rows.c.is_current if by_value else rows.c.is_current + 0) == 1)
        if by_value:
            query = query.where(rows.c.is_current.in_([0, 1]))
        return rows, query.where(rows.c.protocol_id == chosen)

    def figure_of(self, key: str, runs: FromClause) -> ColumnElement[Any]:
        """The value of a metric for a row of ``runs``; NULL if it has none."""
        found = self.figures(key, by_value=False)
        if found is None:
            return literal(None)
        rows, query = found
        return query.with_only_columns(rows.c.value).where(rows.c.run_id == runs.c.id).limit(1).scalar_subquery()

    def parameter_of(self, name: str, runs: FromClause) -> ColumnElement[Any]:
        """The number of a parameter; NULL if the configuration has none."""
        rows, among = self.parameter_rows(name)
        query = select(func.min(rows.c.number_value)).where(rows.c.configuration_id == runs.c.configuration_id, among)
        return query.scalar_subquery()

    def parameter_rows(self, name: str) -> tuple[FromClause, ColumnElement[bool]]:
        """The table with the values of a parameter or variant option, and the condition for its rows."""
        if name.startswith(VARIANT_PREFIX):
            options = VariantOption.__table__.alias()
            return options, options.c.name == name.removeprefix(VARIANT_PREFIX)
        rows = ConfigurationValue.__table__.alias()
        return rows, rows.c.parameter_id.in_(self._names.parameters[name])

    def figures_where(self, leaf: Condition, *, by_value: bool) -> tuple[FromClause, Select[Any]] | None:
        """The rows of one metric that fulfil a comparison; see :meth:`figures`."""
        found = self.figures(leaf.field.name, by_value=by_value)
        if found is None or leaf.sign in PRESENCE:
            return found
        rows, query = found
        value = rows.c.value if by_value else rows.c.value + 0
        return rows, query.where(self.compare(value, leaf))

    def configurations_where(self, leaf: Condition) -> Select[Any]:
        """The ``configuration_id`` of the configurations that fulfil a comparison, each once, through an index."""
        if leaf.field.source is not Source.PARAMETER:
            rows, query = self._configurations(leaf)
            return query.with_only_columns(rows.c.id.label("configuration_id"))
        values, query = self._parameter_values(leaf, by_value=True)
        chosen = query.with_only_columns(values.c.configuration_id)
        several = len(self._names.parameters[leaf.field.name]) > 1  # one key may be the general name of another
        return chosen.distinct() if several else chosen

    def _parameter_values(self, leaf: Condition, *, by_value: bool) -> tuple[FromClause, Select[Any]]:
        rows, among = self.parameter_rows(leaf.field.name)
        query = select(literal(1)).select_from(rows).where(among)
        if leaf.sign in PRESENCE:
            return rows, query
        value: ColumnElement[Any] = rows.c.text_value
        if leaf.field.kind not in {Kind.TEXT, Kind.CHOICE}:
            value = rows.c.number_value if by_value else rows.c.number_value + 0
        return rows, query.where(self.compare(value, leaf))

    def _configurations(self, leaf: Condition) -> tuple[FromClause, Select[Any]]:
        rows = Configuration.__table__.alias()
        query = select(literal(1)).select_from(rows)
        return rows, query.where(self._on_configuration(leaf, rows))

    def _on_configuration(self, leaf: Condition, rows: FromClause) -> ColumnElement[bool]:
        name = leaf.field.name
        algorithms, datasets = Algorithm.__table__.alias(), Dataset.__table__.alias()
        if leaf.field.source in {Source.SETUP, Source.ATTRIBUTE}:
            owners, key = (
                (algorithms, "algorithm_id") if leaf.field.source is Source.SETUP else (datasets, "dataset_id")
            )
            return rows.c[key].in_(select(owners.c.id).where(owners.c.name.in_(sorted(members_of(leaf)))))
        if name in {"variant", "map"}:
            wanted = leaf.sign is Sign.HAS or leaf.values[0] is (leaf.sign is Sign.EQUAL)
            return rows.c[name].is_not(None) if wanted else rows.c[name].is_(None)
        if leaf.sign is Sign.HAS:
            return true()
        if name == "dataset":
            return rows.c.dataset_id.in_(select(datasets.c.id).where(self.compare(datasets.c.name, leaf)))
        if name in {"algorithm", "package"}:
            column = algorithms.c.name if name == "algorithm" else algorithms.c.package
            return rows.c.algorithm_id.in_(select(algorithms.c.id).where(self.compare(column, leaf)))
        return self.compare(rows.c.playback_mode if name == "playback" else rows.c.playback_rate, leaf)

    def compare(self, column: Any, leaf: Condition) -> ColumnElement[bool]:
        """A comparison of a column that holds the values of the field."""
        values: Sequence[Value] = leaf.values
        if leaf.field.source is Source.PARAMETER and values and isinstance(values[0], bool):
            values = [1.0 if value else 0.0 for value in values]
        if leaf.sign in {Sign.IN, Sign.NOT_IN}:
            found: ColumnElement[bool] = column.in_(values)
            return not_(found) if leaf.sign is Sign.NOT_IN else found
        if leaf.sign in {Sign.LIKE, Sign.UNLIKE}:
            found = self._like(column, str(values[0]))
            return not_(found) if leaf.sign is Sign.UNLIKE else found
        if leaf.sign is Sign.BETWEEN:
            return and_(column >= values[0], column <= values[1])
        if len(values) == 2:  # a day: from its first moment to the next day's
            inside = and_(column >= values[0], column < values[1])
            return inside if leaf.sign is Sign.EQUAL else not_(inside)
        return _COMPARE[leaf.sign](column, values[0])

    def _like(self, column: Any, pattern: str) -> ColumnElement[bool]:
        if self._names.glob:
            found: ColumnElement[bool] = column.bool_op("GLOB")(pattern.replace("[", "[[]"))
            return found
        escaped = "".join(f"|{c}" if c in "|%_" else {"*": "%", "?": "_"}.get(c, c) for c in pattern)
        like: ColumnElement[bool] = column.like(escaped, escape="|")
        return like


def _visibility(audience: ColumnElement[Any]) -> ColumnElement[Any]:
    """The visibility in an audience; the other audiences name an owner."""
    others = [kind.value for kind in Visibility if kind is not Visibility.PRIVATE]
    return case((audience.in_(others), audience), else_=Visibility.PRIVATE.value)


def _disturbed_by(column: ColumnElement[Any], leaf: Condition) -> ColumnElement[bool]:
    """A comparison of the kinds of disturbance of a run. There may be several; an undisturbed run has no value."""
    if leaf.sign is Sign.HAS:
        return column > ""
    found = or_(false(), *(column.contains(str(kind), autoescape=True) for kind in leaf.values))
    return and_(column > "", not_(found)) if leaf.sign in COMPLEMENTS else found


def _any(query: Select[Any]) -> ColumnElement[bool]:
    """Whether ``query`` has a row, tested run by run. A database may turn EXISTS into a join over all runs."""
    return func.coalesce(query.limit(1).scalar_subquery(), 0) == 1
