"""Lists of configurations: filters, pages and records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    ForeignKey,
    Integer,
    Select,
    String,
    UniqueConstraint,
    and_,
    delete,
    exists,
    func,
    insert,
    literal,
    or_,
    select,
    update,
)
from sqlalchemy.exc import IntegrityError

from slamhive.base.errors import Conflict, InvalidInput, NotFound, unknown
from slamhive.domain.configuration import Configuration
from slamhive.domain.parameters import ParameterType, Value
from slamhive.store.changes import changes_of
from slamhive.store.configurations import ConfigurationRepository, configuration_of
from slamhive.store.models import (
    NAME_LENGTH,
    TEXT_VALUE_LENGTH,
    AlgorithmRow,
    ConfigurationRow,
    ConfigurationValueRow,
    DatasetRow,
    ExperimentCellRow,
    ExperimentRow,
    ParameterRow,
    RunRow,
    VariantOptionRow,
)
from slamhive.store.rows import Repository, changed, chunks, not_ours
from slamhive.store.run_listing import LARGEST_PAGE
from slamhive.store.tables import TABLE_OPTIONS, LongText, TableBase, column, optional


@dataclass(frozen=True, slots=True)
class StoredParameter:
    """A parameter's definition when the configuration was stored; it may have been edited since.

    ``general`` is the name shared across algorithms, from the newest definition. It finds a value and is no part of its
    meaning.
    """

    type: str
    unit: str
    general: str | None


@dataclass(frozen=True, slots=True)
class ConfigurationRecord:
    """A configuration, what users say about it, and what depends on it.

    ``parameters``: {key: definition}. ``runs`` counts its runs, ``experiments`` names the experiments that contain it.
    """

    id: int
    configuration: Configuration
    created_at: datetime
    name: str | None = None
    note: str = ""
    groups: tuple[str, ...] = ()
    runs: int = 0
    experiments: tuple[str, ...] = ()
    parameters: dict[str, StoredParameter] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """``configuration 12`` or ``configuration 12 (half rate)``."""
        return f"configuration {self.id}" + (f" ({self.name})" if self.name else "")

    def value(self, name: str) -> Value | None:
        """The value of the parameter whose key or general name is ``name`` (the key wins), None if there is none."""
        values = self.configuration.parameters
        if name in values:
            return values[name]
        return next((values[key] for key, definition in self.parameters.items() if definition.general == name), None)


@dataclass(frozen=True, slots=True)
class ParameterCondition:
    """``name`` (own key or general name) compared by ``operator`` (``=``, ``<``, ``<=``, ``>``, ``>=``) with a text."""

    name: str
    operator: str
    value: str

    def __str__(self) -> str:
        return f"{self.name}{self.operator}{self.value}"


@dataclass(frozen=True, slots=True)
class ConfigurationFilter:
    """A choice of configurations; an empty tuple, an empty text or None does not restrict.

    ``text`` is searched in names and notes, whatever the case. ``used``: with or without runs.
    """

    algorithms: tuple[str, ...] = ()
    datasets: tuple[str, ...] = ()
    group: str = ""
    text: str = ""
    used: bool | None = None
    conditions: tuple[ParameterCondition, ...] = ()


@dataclass(frozen=True, slots=True)
class ConfigurationPage:
    """One page, newest first. ``total`` counts all matches; ``next_key`` asks for the next page; None at the end."""

    records: tuple[ConfigurationRecord, ...]
    total: int
    next_key: str | None


# -- tables ------------------------------------------------------------------------------------------------------------


class ConfigurationLabelRow(TableBase):
    """Name and note of a configuration; there is no row for one without."""

    __tablename__ = "configuration_labels"
    __table_args__ = (UniqueConstraint("name"), TABLE_OPTIONS)
    configuration_id = column(Integer, ForeignKey("configurations.id"), primary_key=True, autoincrement=False)
    name = optional(String(NAME_LENGTH))
    note = column(LongText)


class ConfigurationGroupRow(TableBase):
    """A configuration in a group; a group is there as long as one is in it."""

    __tablename__ = "configuration_groups"
    __table_args__ = ({**TABLE_OPTIONS, "sqlite_with_rowid": False},)
    name = column(String(NAME_LENGTH), primary_key=True)
    configuration_id = column(Integer, ForeignKey("configurations.id"), primary_key=True, index=True)


_BOOLEANS = {"true": 1.0, "false": 0.0}
_LABELS = ConfigurationLabelRow.__table__
_GROUPS = ConfigurationGroupRow.__table__


class ConfigurationBook(Repository):
    """Lists configurations, names, groups and deletes them; their content never changes. Names are unique."""

    def page(self, wanted: ConfigurationFilter, after: str | None, limit: int) -> ConfigurationPage:
        """One page of the configurations that match ``wanted``, newest first.

        Raises InvalidInput for a wrong page size or key, NotFound for a parameter that no configuration has.
        """
        if not 1 <= limit <= LARGEST_PAGE:
            raise InvalidInput(f"page size {limit} is not allowed", f"use 1 to {LARGEST_PAGE}")
        conditions = _conditions(self._connection, wanted)
        total = self._number(select(func.count()).select_from(ConfigurationRow).where(*conditions))
        query = select(ConfigurationRow.id).where(*conditions)
        if after is not None:
            if not after.isascii() or not after.isdigit() or len(after) > 18:  # 19 digits may exceed 64 bits
                raise not_ours(after)
            query = query.where(ConfigurationRow.id < int(after))
        ids = self._column(query.order_by(ConfigurationRow.id.desc()).limit(limit + 1))
        shown = ids[:limit]
        next_key = str(shown[-1]) if len(ids) > limit else None
        return ConfigurationPage(self.records(shown), total, next_key)

    def get(self, configuration_id: int) -> ConfigurationRecord:
        """The configuration with this number; raises NotFound."""
        found = self.records([configuration_id])
        if not found:
            raise NotFound(f"unknown configuration {configuration_id}", "slamhive configuration list shows all")
        return found[0]

    def records(self, configuration_ids: Sequence[int]) -> tuple[ConfigurationRecord, ...]:
        """The configurations with these numbers, in this order; those that do not exist are left out."""
        found: dict[int, ConfigurationRecord] = {}
        for part in chunks(configuration_ids):
            found.update({record.id: record for record in _records(self._connection, part)})
        return tuple(found[entry] for entry in configuration_ids if entry in found)

    def latest_runs(self, configuration_id: int, limit: int) -> list[int]:
        """The numbers of its newest runs, newest first."""
        query = select(RunRow.__table__.c.id).where(RunRow.__table__.c.configuration_id == configuration_id)
        return self._column(query.order_by(RunRow.__table__.c.id.desc()).limit(limit))

    def named(self, name: str) -> int | None:
        """The number of the configuration called ``name``."""
        query = select(_LABELS.c.configuration_id).where(_LABELS.c.name == name)
        return self._connection.execute(query).scalar_one_or_none()

    def with_content(self, content_hash: str) -> int | None:
        """The number of the configuration with this content."""
        table = ConfigurationRow.__table__
        return self._connection.execute(
            select(table.c.id).where(table.c.content_hash == content_hash)
        ).scalar_one_or_none()

    def describe(self, configuration_id: int, name: str | None, note: str) -> None:
        """Set name and note; raises NotFound, or Conflict if another configuration has the name."""
        self.get(configuration_id)
        owner = None if name is None else self.named(name)
        if owner not in (None, configuration_id):
            raise _name_taken(name, owner)
        if name is None and not note:
            self._connection.execute(delete(_LABELS).where(_LABELS.c.configuration_id == configuration_id))
            changes_of(self._connection).described.add(configuration_id)
            return
        values = {"name": name, "note": note}
        changes_of(self._connection).described.add(configuration_id)
        try:
            if changed(
                self._connection, update(_LABELS).where(_LABELS.c.configuration_id == configuration_id).values(values)
            ):
                return
            self._connection.execute(insert(_LABELS).values(configuration_id=configuration_id, **values))
        except IntegrityError:  # another transaction was faster
            raise _name_taken(name, None) from None

    def add_to_group(self, group: str, configuration_ids: Sequence[int]) -> None:
        """Put configurations into a group, which keeps those that it has. Raises NotFound."""
        for configuration_id in dict.fromkeys(configuration_ids):
            if group not in self.get(configuration_id).groups:
                self._connection.execute(insert(_GROUPS).values(name=group, configuration_id=configuration_id))
        changes_of(self._connection).described.update(configuration_ids)

    def remove_from_group(self, group: str, configuration_ids: Sequence[int]) -> None:
        """Take configurations out of a group; an empty group disappears. Raises NotFound for one that is not in it."""
        for configuration_id in dict.fromkeys(configuration_ids):
            place = (_GROUPS.c.name == group, _GROUPS.c.configuration_id == configuration_id)
            if not changed(self._connection, delete(_GROUPS).where(*place)):
                raise NotFound(f"configuration {configuration_id} is not in the group {group!r}")
        changes_of(self._connection).described.update(configuration_ids)

    def groups(self) -> dict[str, int]:
        """All groups by name, and how many configurations each has."""
        query = select(_GROUPS.c.name, func.count()).group_by(_GROUPS.c.name).order_by(_GROUPS.c.name)
        return {row[0]: row[1] for row in self._connection.execute(query)}

    def delete(self, configuration_id: int) -> None:
        """Remove a configuration that nothing depends on; raises NotFound, or Conflict naming what does."""
        record = self.get(configuration_id)
        if record.experiments:
            owner = record.experiments[0]
            raise Conflict(f"{record.label} is part of experiment {owner}", "it stays as long as the experiment does")
        if record.runs:
            raise _has_runs(record.label, f"{record.runs} run{'s' if record.runs > 1 else ''}")
        for table in (_LABELS, _GROUPS, ConfigurationValueRow.__table__, VariantOptionRow.__table__):
            self._connection.execute(delete(table).where(table.c.configuration_id == configuration_id))
        table = ConfigurationRow.__table__
        try:
            self._connection.execute(delete(table).where(table.c.id == configuration_id))
        except IntegrityError:  # a run was queued meanwhile
            raise _has_runs(record.label, "a new run") from None
        changes_of(self._connection).deleted.add(configuration_id)


def _records(connection: Connection, ids: Sequence[int]) -> list[ConfigurationRecord]:
    rows = connection.execute(_query().where(ConfigurationRow.id.in_(ids))).all()
    values = ConfigurationRepository(connection).parameters_of_all(ids)
    definitions = _definitions(connection, ids)
    groups = _lists(
        connection,
        select(ConfigurationGroupRow.configuration_id, ConfigurationGroupRow.name)
        .where(ConfigurationGroupRow.configuration_id.in_(ids))
        .order_by(ConfigurationGroupRow.name),
    )
    experiments = _lists(
        connection,
        select(ExperimentCellRow.configuration_id, ExperimentRow.name)
        .join(ExperimentRow, ExperimentRow.id == ExperimentCellRow.experiment_id)
        .where(ExperimentCellRow.configuration_id.in_(ids))
        .order_by(ExperimentRow.id),
    )
    counted = select(RunRow.configuration_id, func.count()).where(RunRow.configuration_id.in_(ids))
    runs = {row[0]: row[1] for row in connection.execute(counted.group_by(RunRow.configuration_id))}
    return [
        ConfigurationRecord(
            id=row.id,
            configuration=configuration_of(row, values[row.id]),
            created_at=row.created_at,
            name=row.name,
            note=row.note or "",
            groups=groups.get(row.id, ()),
            runs=runs.get(row.id, 0),
            experiments=experiments.get(row.id, ()),
            parameters=definitions.get(row.id, {}),
        )
        for row in rows
    ]


def _query() -> Select[Any]:
    return (
        select(
            ConfigurationRow.id,
            ConfigurationRow.playback_mode,
            ConfigurationRow.playback_rate,
            ConfigurationRow.variant,
            ConfigurationRow.sensors,
            ConfigurationRow.version,
            ConfigurationRow.map,
            ConfigurationRow.created_at,
            AlgorithmRow.name.label("algorithm"),
            DatasetRow.name.label("dataset"),
            ConfigurationLabelRow.name,
            ConfigurationLabelRow.note,
        )
        .join(AlgorithmRow, AlgorithmRow.id == ConfigurationRow.algorithm_id)
        .join(DatasetRow, DatasetRow.id == ConfigurationRow.dataset_id)
        .outerjoin(ConfigurationLabelRow, ConfigurationLabelRow.configuration_id == ConfigurationRow.id)
    )


def _definitions(connection: Connection, ids: Sequence[int]) -> dict[int, dict[str, StoredParameter]]:
    """The definition of each value's parameter when it was stored; the few definitions are read once."""
    used = select(ConfigurationValueRow.parameter_id).where(ConfigurationValueRow.configuration_id.in_(ids)).distinct()
    rows = connection.execute(select(ParameterRow.__table__).where(ParameterRow.id.in_(used)))
    known = {row.id: (row.key, StoredParameter(row.type, row.unit, row.general)) for row in rows}
    pairs = select(ConfigurationValueRow.configuration_id, ConfigurationValueRow.parameter_id)
    found: dict[int, dict[str, StoredParameter]] = {}
    for configuration_id, parameter_id in connection.execute(
        pairs.where(ConfigurationValueRow.configuration_id.in_(ids))
    ):
        key, definition = known[parameter_id]
        found.setdefault(configuration_id, {})[key] = definition
    return found


def _lists(connection: Connection, query: Select[int, str]) -> dict[int, tuple[str, ...]]:
    """Rows of id and name as {id: names}, each name once and in order."""
    found: dict[int, dict[str, None]] = {}
    for configuration_id, name in connection.execute(query):
        found.setdefault(configuration_id, {})[name] = None
    return {configuration_id: tuple(names) for configuration_id, names in found.items()}


def _conditions(connection: Connection, wanted: ConfigurationFilter) -> list[ColumnElement[bool]]:
    table = ConfigurationRow.__table__.c
    conditions: list[ColumnElement[bool]] = []
    if wanted.algorithms:
        named = select(AlgorithmRow.id).where(AlgorithmRow.name.in_(wanted.algorithms))
        conditions.append(table.algorithm_id.in_(named))
    if wanted.datasets:
        conditions.append(table.dataset_id.in_(select(DatasetRow.id).where(DatasetRow.name.in_(wanted.datasets))))
    if wanted.group:
        members = select(ConfigurationGroupRow.configuration_id).where(ConfigurationGroupRow.name == wanted.group)
        conditions.append(table.id.in_(members))
    if wanted.text:
        text = wanted.text.lower()
        labelled = select(ConfigurationLabelRow.configuration_id).where(
            or_(
                func.lower(ConfigurationLabelRow.name).contains(text, autoescape=True),
                func.lower(ConfigurationLabelRow.note).contains(text, autoescape=True),
            )
        )
        conditions.append(table.id.in_(labelled))
    if wanted.used is not None:
        has_runs = exists(select(literal(1)).where(RunRow.configuration_id == table.id))
        conditions.append(has_runs if wanted.used else ~has_runs)
    return [*conditions, *(table.id.in_(_matching(connection, condition)) for condition in wanted.conditions)]


def _matching(connection: Connection, condition: ParameterCondition) -> Select[Any]:
    """Ids of the configurations whose parameter of that key or general name fulfils the condition."""
    named = or_(ParameterRow.key == condition.name, ParameterRow.general == condition.name)
    rows = connection.execute(select(ParameterRow.id, ParameterRow.type).where(named)).all()
    if not rows:
        known = connection.execute(select(ParameterRow.key, ParameterRow.general).distinct()).all()
        names = sorted({name for row in known for name in row if name})
        raise unknown("parameter of any stored configuration", condition.name, names)
    tests = [
        and_(ConfigurationValueRow.parameter_id == row.id, test)
        for row in rows
        for test in _tests(ParameterType(row.type), condition)
    ]
    return select(ConfigurationValueRow.configuration_id).where(or_(literal(value=False), *tests))


def _tests(kind: ParameterType, condition: ParameterCondition) -> list[ColumnElement[bool]]:
    """The tests of a value of this type; none if no value of it can be meant."""
    text, equal = condition.value.strip(), condition.operator == "="
    if kind in (ParameterType.STRING, ParameterType.ENUM):
        return [ConfigurationValueRow.text_value == condition.value[:TEXT_VALUE_LENGTH]] if equal else []
    if kind is ParameterType.MATRIX:
        numbers = [_number(part) for part in text.strip("[]").split(",")]
        return [ConfigurationValueRow.value == numbers] if equal and None not in numbers else []
    number = _BOOLEANS.get(text.lower()) if kind is ParameterType.BOOL else _number(text)
    if number is None:
        return []
    column = ConfigurationValueRow.__table__.c.number_value
    comparisons: dict[str, ColumnElement[bool]] = {
        "=": column == number,
        "<": column < number,
        "<=": column <= number,
        ">": column > number,
        ">=": column >= number,
    }
    return [comparisons[condition.operator]]


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _has_runs(label: str, runs: str) -> Conflict:
    remedy = "a configuration with runs must stay; take it out of its groups, or rename it"
    return Conflict(f"{label} has {runs}", remedy)


def _name_taken(name: str | None, owner: int | None) -> Conflict:
    of = "another configuration" if owner is None else f"configuration {owner}"
    return Conflict(f"the name {name!r} belongs to {of}", "choose another")
