"""Conditions of a search as SQL: a test of one run, and the rows behind one comparison.

The way a condition is written decides which index both databases use: ``column + 0`` forbids an index. A query thus
keeps its plan even if the statistics of the tables are old.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    Dialect,
    FromClause,
    Select,
    TableClause,
    and_,
    bindparam,
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
    union,
)
from sqlalchemy.types import UserDefinedType

from slamhive.base.errors import unknown
from slamhive.domain.accounts import Visibility
from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.parameters import ParameterType
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import DROPPED_FRAMES, LIMITS, TrustLevel
from slamhive.domain.verdict import VerdictKind
from slamhive.filters.binding import Bound, Condition, Search, Value, members_of
from slamhive.filters.fields import (
    BUILT_IN,
    OF_CONFIGURATIONS,
    VARIANT_PREFIX,
    Field,
    FieldKind,
    ParameterKind,
    Source,
    metric_field,
)
from slamhive.filters.syntax import PRESENCE, Junction, Sign, all_of, join, leaves
from slamhive.store.metrics import CODES, VERDICT
from slamhive.store.models import (
    AlgorithmRow,
    AlgorithmVersionRow,
    ConfigurationRow,
    ConfigurationValueRow,
    DatasetRow,
    ExperimentRow,
    MetricRow,
    MetricValueRow,
    ParameterRow,
    ProtocolRow,
    RunNoteRow,
    RunRow,
    RunTagRow,
    VariantOptionRow,
)
from slamhive.store.tables import TableBase

# -- comparisons with the note and the tags of runs, as the rows behind them -------------------------------------------

OPPOSITE = {Sign.NOT_EQUAL: Sign.EQUAL, Sign.NOT_IN: Sign.IN, Sign.UNLIKE: Sign.LIKE}
"""The comparisons that a run fulfils if it does not fulfil the other one: a run may have several tags."""


def noted(leaf: Condition, compare: Callable[[Any, Condition], ColumnElement[bool]]) -> tuple[FromClause, Select[Any]]:
    """The rows of notes or tags that fulfil a comparison; ``compare`` makes it a condition on a column."""
    rows = (RunTagRow if leaf.field.name == "tag" else RunNoteRow).__table__.alias()
    query = select(literal(1)).select_from(rows)
    return rows, query if leaf.sign in PRESENCE else query.where(compare(rows.c[leaf.field.name], leaf))


# -- comparisons of the trust in a run, as comparisons of what was measured --------------------------------------------


def trust_tree(leaf: Condition) -> Bound:
    """The condition behind ``leaf``, which names levels of trust."""
    levels = list(TrustLevel) if leaf.sign is Sign.HAS else [TrustLevel(str(value)) for value in leaf.values]
    low = _above({limit.metric: limit.low_above for limit in LIMITS})
    doubtful = join("or", [_above({limit.metric: limit.limited_above for limit in LIMITS}), _disturbed(yes=True)])
    # Playback in sequence waits for the algorithm and drops nothing; in real time, dropped frames must be counted.
    counted = join("or", [_playback(PlaybackMode.SEQUENTIAL), Condition(metric_field(DROPPED_FRAMES), Sign.HAS)])
    trees = {
        TrustLevel.HIGH: join("and", [_disturbed(yes=False), counted, Junction("not", (doubtful,))]),
        TrustLevel.LIMITED: join("and", [doubtful, Junction("not", (low,))]),
        TrustLevel.LOW: low,
    }
    ended = (RunState.SUCCEEDED.value, RunState.FAILED.value) if levels else ()
    parts: list[Bound] = [
        Condition(BUILT_IN["state"], Sign.IN, ended),
        Condition(BUILT_IN["executor"], Sign.NOT_EQUAL, (IMPORTED,)),
    ]
    if levels:
        parts.append(join("or", [trees[level] for level in levels]))
    return join("and", parts)


def _above(values: dict[str, float | None]) -> Bound:
    """Test if one of these metrics exceeds its value. Some count in real time only."""
    parts: list[Bound] = []
    for limit in LIMITS:
        value = values[limit.metric]
        if value is not None:
            above = Condition(metric_field(limit.metric), Sign.MORE, (value,))
            parts.append(join("and", [above, _playback(PlaybackMode.REALTIME)]) if limit.realtime_only else above)
    return join("or", parts)


def _playback(mode: PlaybackMode) -> Condition:
    return Condition(BUILT_IN["playback"], Sign.EQUAL, (mode.value,))


def _disturbed(*, yes: bool) -> Condition:
    return Condition(BUILT_IN["disturbed"], Sign.EQUAL, (yes,))


# -- comparisons of the verdict, as comparisons of the state of a run and of the stored verdict ------------------------

_STORED = Field(VERDICT, "stored verdict", FieldKind.NUMBER, Source.METRIC)
STORED_FAILURE = Condition(_STORED, Sign.MORE, (CODES[VerdictKind.GOOD],))
"""Runs that succeeded and failed by their verdict."""


def verdict_tree(leaf: Condition) -> Bound:
    """The condition behind ``leaf``, which names kinds of verdicts."""
    kinds = list(VerdictKind) if leaf.sign is Sign.HAS else [VerdictKind(str(value)) for value in leaf.values]
    codes = tuple(CODES[kind] for kind in kinds if kind in CODES)
    parts: list[Bound] = [Condition(_STORED, Sign.IN, codes)] if codes else []
    if VerdictKind.ENDED_BADLY in kinds:
        failed = Condition(BUILT_IN["state"], Sign.EQUAL, (RunState.FAILED.value,))
        kept = Condition(BUILT_IN["reason"], Sign.NOT_EQUAL, (FailureReason.LOST.value,))
        parts.append(join("and", [failed, kept]))
    return join("or", parts) if parts else Condition(_STORED, Sign.IN, ())


# -- the ids behind the names of a search: metrics, parameters and protocols -------------------------------------------

_KINDS = {
    ParameterType.INT: FieldKind.NUMBER,
    ParameterType.FLOAT: FieldKind.NUMBER,
    ParameterType.BOOL: FieldKind.FLAG,
    ParameterType.STRING: FieldKind.TEXT,
    ParameterType.ENUM: FieldKind.TEXT,
}


@dataclass(frozen=True, slots=True)
class Names:
    """The ids behind the names of a search and of the order of its list.

    ``parameters``: {key or general name: ids}. ``protocol_id``: the chosen protocol, None for each run's current one.
    ``mixed``: whether several protocols may have computed the values that a mean is over.
    ``glob``: whether the database has GLOB, else LIKE with a binary collation.
    """

    metrics: dict[str, int]
    parameters: dict[str, tuple[int, ...]]
    protocol_id: int | None
    mixed: bool
    glob: bool


def look_up(connection: Connection, search: Search, parameters: Iterable[str] = ()) -> Names:
    """The ids behind ``search`` and further ``parameters``; raises NotFound for an unknown protocol."""
    asked = [] if search.tree is None else list(leaves(search.tree))
    chosen = None if search.protocol is None else _protocol_id(connection, search.protocol)
    mixed = chosen is None
    if mixed and any(leaf.field.source is Source.MEAN for leaf in asked):
        lowest, highest = (select(end(RUNS.c.current_protocol_id)).scalar_subquery() for end in (func.min, func.max))
        mixed = bool(connection.execute(select(lowest != highest)).scalar_one())
    wanted = {*parameters, *(leaf.field.name for leaf in asked if leaf.field.source is Source.PARAMETER)}
    return Names(
        metrics={row.key: row.id for row in connection.execute(select(MetricRow.key, MetricRow.id))},
        parameters=_parameter_ids(connection, wanted),
        protocol_id=chosen,
        mixed=mixed,
        glob=connection.dialect.name == "sqlite",
    )


def stored_parameters(connection: Connection) -> list[ParameterKind]:
    """Every parameter of any configuration, by key and by general name, and every option of variants.

    For matrices only ``has`` is useful: they are text that nothing equals.
    """
    found = []
    for key, general, kind, unit in connection.execute(
        select(ParameterRow.key, ParameterRow.general, ParameterRow.type, ParameterRow.unit).order_by(ParameterRow.id)
    ):
        meaning = _KINDS.get(ParameterType(kind), FieldKind.TEXT)
        found += [ParameterKind(name, meaning, unit) for name in dict.fromkeys((key, general)) if name is not None]
    options = select(
        VariantOptionRow.name, func.count(VariantOptionRow.number_value), func.count(VariantOptionRow.text_value)
    )
    for name, numbers, texts in connection.execute(options.group_by(VariantOptionRow.name)):
        kinds = [FieldKind.NUMBER] * bool(numbers) + [FieldKind.TEXT] * bool(texts)
        found += [ParameterKind(VARIANT_PREFIX + name, kind) for kind in kinds]
    return found


def _parameter_ids(connection: Connection, names: set[str]) -> dict[str, tuple[int, ...]]:
    if not names:
        return {}
    table = ParameterRow.__table__
    found: dict[str, list[int]] = {name: [] for name in names}
    named = or_(table.c.key.in_(names), table.c.general.in_(names))
    for row in connection.execute(select(table.c.id, table.c.key, table.c.general).where(named)):
        for name in {row.key, row.general} & names:
            found[name].append(row.id)
    return {name: tuple(ids) for name, ids in found.items()}


def _protocol_id(connection: Connection, fingerprint: str) -> int:
    table = ProtocolRow.__table__
    known = {row.fingerprint: row.id for row in connection.execute(select(table.c.fingerprint, table.c.id))}
    if fingerprint not in known:
        raise unknown("protocol", fingerprint, list(known))
    return int(known[fingerprint])


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
    *("algorithm_version_id", "owner", "audience", "cpu_cores", "memory_mb", "slow_down"),
)


def _plain(model: type[TableBase], *names: str) -> TableClause:
    """The columns that searches need: an alias of the whole model takes longer to make than many queries take."""
    return table(model.__tablename__, *(column(name, model.__table__.c[name].type) for name in names))


RUNS = _plain(RunRow, *SEARCHED)
FIGURES = _plain(MetricValueRow, "metric_id", "run_id", "protocol_id", "value", "is_current")
NULLABLE = frozenset(name for name in SEARCHED if RunRow.__table__.c[name].nullable)
_NAMED = {"experiment": ExperimentRow.__table__.c.name, "version": AlgorithmVersionRow.__table__.c.number}
"""Columns of runs that hold an id; what is compared is in its row."""

_GUARDED = NULLABLE | {"state"}
"""With an index on the state, databases would sort all matches instead of walking along the order of a list."""

NEVER = literal(0) == 1
"""``false()`` would be folded, together with the condition that joins two tables."""

DERIVED: dict[Source, Callable[[Condition], Bound]] = {Source.VERDICT: verdict_tree, Source.TRUST: trust_tree}
"""The conditions behind comparisons of what follows from other values."""

COMPLEMENTS = frozenset({Sign.NOT_EQUAL, Sign.NOT_IN, Sign.UNLIKE, Sign.MISSING})
_MOST_PARAMETERS = 100
_NOTHING = "SELECT 1 FROM (SELECT 1 AS one) AS empty_list WHERE 1 != 1"
_NEEDS_ONE = frozenset({Sign.LESS, Sign.AT_MOST, Sign.MORE, Sign.AT_LEAST})
"""Comparisons that some value fulfils if the mean of all does."""
_COMPARE: dict[Sign, Callable[[Any, Any], ColumnElement[bool]]] = {
    Sign.EQUAL: lambda column, value: column == value,
    Sign.NOT_EQUAL: lambda column, value: column != value,
    Sign.LESS: lambda column, value: column < value,
    Sign.AT_MOST: lambda column, value: column <= value,
    Sign.MORE: lambda column, value: column > value,
    Sign.AT_LEAST: lambda column, value: column >= value,
}


class Sql:
    """The conditions of one search.

    Args:
        names: The ids behind its names.
        averaged: The runs that means are over, besides that they did not fail; None for all.
        wide: Conditions on means that so many single values fulfil that these exclude few configurations.
    """

    def __init__(self, names: Names, averaged: Bound | None = None, wide: Collection[Condition] = ()) -> None:
        self._names = names
        self._averaged = averaged
        self._wide = wide

    # -- a test of one run -----------------------------------------------------------------------------------------

    def test(self, tree: Bound | None, runs: FromClause) -> ColumnElement[bool]:
        """Test if a row of ``runs`` matches; never NULL."""
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
        if source is Source.RUN:
            return self.on_run(leaf, runs)
        if source is Source.MEAN:
            return self._test_mean(leaf, runs)
        if source is Source.METRIC:
            figures = self.figures_where(leaf, by_value=False)
            return NEVER if figures is None else _any(figures[1].where(figures[0].c.run_id == runs.c.id))
        if source is Source.NOTE:
            # A run may have several tags. It fulfils ``!=`` if none of them equals the value.
            rows, query = noted(replace(leaf, sign=OPPOSITE.get(leaf.sign, leaf.sign)), self.compare)
            found = _any(query.where(rows.c.run_id == runs.c.id))
            return not_(found) if leaf.sign in OPPOSITE else found
        of_values = source is Source.PARAMETER
        rows, query = self._parameter_values(leaf, by_value=False) if of_values else self._configurations(leaf)
        configuration = rows.c.configuration_id if of_values else rows.c.id
        return _any(query.where(configuration == runs.c.configuration_id))

    def _test_mean(self, leaf: Condition, runs: FromClause) -> ColumnElement[bool]:
        """Test if the mean over the runs of the same configuration fulfils a comparison, under one protocol."""
        found = self.figures(leaf.field.name, by_value=False)
        if found is None:
            return NEVER
        figures, query = found
        own = RUNS.alias()
        means = (
            query.with_only_columns(own.c.configuration_id)
            # ``+ 0`` makes databases walk over the runs of each configuration. The other way round, along the values,
            # takes twice as long, because their runs lie all over the table.
            .join_from(own, figures, figures.c.run_id == own.c.id + 0)
            .where(self.test(self._averaged, own), not_(self.failed(own)))
            # The index has the order of the configurations; with the protocol, all values would have to be sorted.
            .group_by(own.c.configuration_id, *([figures.c.protocol_id] if self._names.mixed else []))
        )
        if leaf.sign is not Sign.HAS:
            means = means.having(self.compare(func.avg(figures.c.value), leaf))
        some = None if leaf in self._wide else self.some_value(leaf)
        if some is not None:
            # Where a mean is small, some value is: few small values leave few configurations.
            its = RUNS.alias()
            near = (
                some[1].with_only_columns(its.c.configuration_id).join_from(some[0], its, its.c.id == some[0].c.run_id)
            )
            means = means.where(own.c.configuration_id.in_(near))
        return runs.c.configuration_id.in_(means)

    def some_value(self, leaf: Condition) -> tuple[FromClause, Select[Any]] | None:
        """The values of single runs one of which has to fulfil ``leaf`` if a mean does; None if none has to."""
        if leaf.sign not in _NEEDS_ONE:
            return None
        return self.figures_where(replace(leaf, field=replace(leaf.field, source=Source.METRIC)), by_value=True)

    def on_run(self, leaf: Condition, runs: FromClause, *, guarded: bool = True) -> ColumnElement[bool]:
        """A condition on a column. If ``guarded`` it is never NULL and uses no index."""
        name = _RUN_COLUMNS.get(leaf.field.name, leaf.field.name)
        value = runs.c[name]
        if leaf.field.name == "disturbed_by":
            # A run may have several kinds of disturbance; an undisturbed one has no value.
            there = value > ""
            if leaf.sign is not Sign.HAS:
                kinds = or_(false(), *(value.contains(str(kind), autoescape=True) for kind in leaf.values))
                there = and_(there, not_(kinds)) if leaf.sign in COMPLEMENTS else kinds
            return func.coalesce(there, false())
        if leaf.sign is Sign.HAS:
            return value.is_not(None)
        if leaf.field.name == "visibility":
            # An audience is a visibility, or names the owner of a private run.
            shared = runs.c.audience.in_([kind.value for kind in Visibility if kind is not Visibility.PRIVATE])
            return self.compare(case((shared, runs.c.audience), else_=Visibility.PRIVATE.value), leaf)
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
        """Test if a row of ``runs`` counts as failed, by its end or by its verdict."""
        # A run that was taken away is lost, and has not failed.
        kept = func.coalesce(runs.c.reason != FailureReason.LOST, true())
        ended_badly: ColumnElement[bool] = and_(runs.c.state == RunState.FAILED, kept)
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
            # Every row fulfils it. It lets the index be used, in which ``is_current`` stands before the value.
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
            options = VariantOptionRow.__table__.alias()
            return options, options.c.name == name.removeprefix(VARIANT_PREFIX)
        rows = ConfigurationValueRow.__table__.alias()
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
        if leaf.field.kind not in {FieldKind.TEXT, FieldKind.CHOICE}:
            value = rows.c.number_value if by_value else rows.c.number_value + 0
        return rows, query.where(self.compare(value, leaf))

    def _configurations(self, leaf: Condition) -> tuple[FromClause, Select[Any]]:
        rows = ConfigurationRow.__table__.alias()
        query = select(literal(1)).select_from(rows)
        return rows, query.where(self._on_configuration(leaf, rows))

    def _on_configuration(self, leaf: Condition, rows: FromClause) -> ColumnElement[bool]:
        name = leaf.field.name
        algorithms, datasets = AlgorithmRow.__table__.alias(), DatasetRow.__table__.alias()
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
            numbers = [value for value in values if isinstance(value, int)]
            many = len(numbers) == len(values) > _MOST_PARAMETERS
            found: ColumnElement[bool] = among(column, numbers) if many else column.in_(values)
            return not_(found) if leaf.sign is Sign.NOT_IN else found
        if leaf.sign in {Sign.LIKE, Sign.UNLIKE}:
            pattern = str(values[0])
            if self._names.glob:
                found = column.bool_op("GLOB")(pattern.replace("[", "[[]"))
            else:
                # MySQL has no GLOB. LIKE distinguishes case under the binary collation of the tables.
                escaped = "".join(f"|{c}" if c in "|%_" else {"*": "%", "?": "_"}.get(c, c) for c in pattern)
                found = column.like(escaped, escape="|")
            return not_(found) if leaf.sign is Sign.UNLIKE else found
        if leaf.sign is Sign.BETWEEN:
            return and_(column >= values[0], column <= values[1])
        if len(values) == 2:  # a day: from its first moment to the next day's
            inside = and_(column >= values[0], column < values[1])
            return inside if leaf.sign is Sign.EQUAL else not_(inside)
        return _COMPARE[leaf.sign](column, values[0])


def among(column: ColumnElement[int], ids: Sequence[int]) -> ColumnElement[bool]:
    """Test for one of ``ids``. They become part of the statement: drivers limit the number of parameters."""
    return column.bool_op("IN")(bindparam(None, ids, type_=_Ids(), literal_execute=True))


class _Ids(UserDefinedType[Sequence[int]]):
    """Ids in brackets, rendered at once. Rendered one by one, they take longer than the database needs for them."""

    cache_ok = True

    def literal_processor(self, dialect: Dialect) -> Callable[[Sequence[int]], str]:  # noqa: ARG002
        """Digits with commas between them; without ids, a query that finds nothing."""
        return lambda ids: f"({', '.join(map(str, map(int, ids))) or _NOTHING})"


def _any(query: Select[Any]) -> ColumnElement[bool]:
    """Test if ``query`` has a row, run by run. A database may turn EXISTS into a join over all runs."""
    return func.coalesce(query.limit(1).scalar_subquery(), 0) == 1


# -- starts of a search: lists of runs that an index yields and that contain every match -------------------------------

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
        """The cost of testing one run, compared with other starts."""
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
            others = [*tree.parts[:place], *tree.parts[place + 1 :]]
            # What the other parts leave is tested on each row of the list.
            shared = [other for other in others if _of_configuration(other)] if _of_configuration(part) else []
            rest = [other for other in others if other not in shared]
            for start in starts(part):
                yield Start(start.part, all_of([start.rest, *rest]), all_of([start.also, *shared]))
    elif tree is not None and tree.word == "or":
        firsts = [next(starts(part), None) for part in tree.parts]
        if None not in firsts:
            exact = all(start is not None and start.rest is None for start in firsts)
            yield Start(tree, rest=None if exact else tree)


def _of_configuration(part: Bound) -> bool:
    return isinstance(part, Condition) and part.field.source in OF_CONFIGURATIONS


def _has_index(leaf: Condition) -> bool:
    if leaf.field.source is Source.METRIC:
        return leaf.sign is not Sign.MISSING
    if leaf.field.source is Source.MEAN or leaf.sign in COMPLEMENTS:
        return False
    return leaf.field.source is not Source.RUN or (leaf.field.name in _INDEXED and leaf.sign is not Sign.HAS)
