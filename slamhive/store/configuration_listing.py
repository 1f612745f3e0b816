"""Lists of configurations: filters, pages and records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from sqlalchemy import ColumnElement, Connection, Select, and_, exists, func, literal, or_, select

from slamhive.domain.parameters import ParameterType
from slamhive.errors import InvalidInput, unknown
from slamhive.store.configuration_models import ConfigurationGroup, ConfigurationLabel
from slamhive.store.configuration_records import (
    ConfigurationFilter,
    ConfigurationPage,
    ConfigurationRecord,
    ParameterCondition,
    StoredParameter,
)
from slamhive.store.configurations import ConfigurationRepository, configuration_of
from slamhive.store.models import (
    TEXT_VALUE_LENGTH,
    Algorithm,
    Configuration,
    ConfigurationValue,
    Dataset,
    Experiment,
    ExperimentCell,
    Parameter,
    Run,
)
from slamhive.store.rows import chunks
from slamhive.store.run_listing import LARGEST_PAGE

_BOOLEANS = {"true": 1.0, "false": 0.0}


def list_configurations(
    connection: Connection, wanted: ConfigurationFilter, after: str | None, limit: int
) -> ConfigurationPage:
    """One page of the configurations that match ``wanted``, newest first.

    Raises InvalidInput for a wrong page size or key, NotFound for a parameter that no configuration has.
    """
    if not 1 <= limit <= LARGEST_PAGE:
        raise InvalidInput(f"page size {limit} is not allowed", f"use 1 to {LARGEST_PAGE}")
    conditions = _conditions(connection, wanted)
    total = int(connection.execute(select(func.count()).select_from(Configuration).where(*conditions)).scalar_one())
    query = select(Configuration.id).where(*conditions)
    if after is not None:
        query = query.where(Configuration.id < _page_key(after))
    ids = connection.execute(query.order_by(Configuration.id.desc()).limit(limit + 1)).scalars().all()
    shown = ids[:limit]
    return ConfigurationPage(
        records=configuration_records(connection, shown),
        total=total,
        next_key=str(shown[-1]) if len(ids) > limit else None,
    )


def configuration_records(connection: Connection, ids: Sequence[int]) -> tuple[ConfigurationRecord, ...]:
    """The configurations with these ids, in this order; unknown ids are left out."""
    found: dict[int, ConfigurationRecord] = {}
    for part in chunks(ids):
        found.update({record.id: record for record in _records(connection, part)})
    return tuple(found[entry] for entry in ids if entry in found)


def _records(connection: Connection, ids: Sequence[int]) -> list[ConfigurationRecord]:
    rows = connection.execute(_query().where(Configuration.id.in_(ids))).all()
    values = ConfigurationRepository(connection).parameters_of_all(ids)
    definitions = _definitions(connection, ids)
    groups = _lists(
        connection,
        select(ConfigurationGroup.configuration_id, ConfigurationGroup.name)
        .where(ConfigurationGroup.configuration_id.in_(ids))
        .order_by(ConfigurationGroup.name),
    )
    experiments = _lists(
        connection,
        select(ExperimentCell.configuration_id, Experiment.name)
        .join(Experiment, Experiment.id == ExperimentCell.experiment_id)
        .where(ExperimentCell.configuration_id.in_(ids))
        .order_by(Experiment.id),
    )
    counted = select(Run.configuration_id, func.count()).where(Run.configuration_id.in_(ids))
    runs = {row[0]: row[1] for row in connection.execute(counted.group_by(Run.configuration_id))}
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
            Configuration.id,
            Configuration.playback_mode,
            Configuration.playback_rate,
            Configuration.variant,
            Configuration.sensors,
            Configuration.version,
            Configuration.map,
            Configuration.created_at,
            Algorithm.name.label("algorithm"),
            Dataset.name.label("dataset"),
            ConfigurationLabel.name,
            ConfigurationLabel.note,
        )
        .join(Algorithm, Algorithm.id == Configuration.algorithm_id)
        .join(Dataset, Dataset.id == Configuration.dataset_id)
        .outerjoin(ConfigurationLabel, ConfigurationLabel.configuration_id == Configuration.id)
    )


def _definitions(connection: Connection, ids: Sequence[int]) -> dict[int, dict[str, StoredParameter]]:
    """How each value's parameter was defined when it was stored; the few definitions are read once."""
    used = select(ConfigurationValue.parameter_id).where(ConfigurationValue.configuration_id.in_(ids)).distinct()
    rows = connection.execute(select(Parameter.__table__).where(Parameter.id.in_(used)))
    known = {row.id: (row.key, StoredParameter(row.type, row.unit, row.general)) for row in rows}
    pairs = select(ConfigurationValue.configuration_id, ConfigurationValue.parameter_id)
    found: dict[int, dict[str, StoredParameter]] = {}
    for configuration_id, parameter_id in connection.execute(pairs.where(ConfigurationValue.configuration_id.in_(ids))):
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
    table = Configuration.__table__.c
    conditions: list[ColumnElement[bool]] = []
    if wanted.algorithms:
        named = select(Algorithm.id).where(Algorithm.name.in_(wanted.algorithms))
        conditions.append(table.algorithm_id.in_(named))
    if wanted.datasets:
        conditions.append(table.dataset_id.in_(select(Dataset.id).where(Dataset.name.in_(wanted.datasets))))
    if wanted.group:
        members = select(ConfigurationGroup.configuration_id).where(ConfigurationGroup.name == wanted.group)
        conditions.append(table.id.in_(members))
    if wanted.text:
        text = wanted.text.lower()
        labelled = select(ConfigurationLabel.configuration_id).where(
            or_(
                func.lower(ConfigurationLabel.name).contains(text, autoescape=True),
                func.lower(ConfigurationLabel.note).contains(text, autoescape=True),
            )
        )
        conditions.append(table.id.in_(labelled))
    if wanted.used is not None:
        has_runs = exists(select(literal(1)).where(Run.configuration_id == table.id))
        conditions.append(has_runs if wanted.used else ~has_runs)
    return [*conditions, *(table.id.in_(_matching(connection, condition)) for condition in wanted.conditions)]


def _matching(connection: Connection, condition: ParameterCondition) -> Select[Any]:
    """Ids of the configurations whose parameter of that key or general name fulfils the condition."""
    named = or_(Parameter.key == condition.name, Parameter.general == condition.name)
    rows = connection.execute(select(Parameter.id, Parameter.type).where(named)).all()
    if not rows:
        known = connection.execute(select(Parameter.key, Parameter.general).distinct()).all()
        names = sorted({name for row in known for name in row if name})
        raise unknown("parameter of any stored configuration", condition.name, names)
    tests = [
        and_(ConfigurationValue.parameter_id == row.id, test)
        for row in rows
        for test in _tests(ParameterType(row.type), condition)
    ]
    return select(ConfigurationValue.configuration_id).where(or_(literal(value=False), *tests))


def _tests(kind: ParameterType, condition: ParameterCondition) -> list[ColumnElement[bool]]:
    """What a value of this type has to be; none if no value of it can be meant."""
    text, equal = condition.value.strip(), condition.operator == "="
    if kind in (ParameterType.STRING, ParameterType.ENUM):
        return [ConfigurationValue.text_value == condition.value[:TEXT_VALUE_LENGTH]] if equal else []
    if kind is ParameterType.MATRIX:
        numbers = [_number(part) for part in text.strip("[]").split(",")]
        return [ConfigurationValue.value == numbers] if equal and None not in numbers else []
    number = _BOOLEANS.get(text.lower()) if kind is ParameterType.BOOL else _number(text)
    if number is None:
        return []
    column = ConfigurationValue.__table__.c.number_value
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


def _page_key(text: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 18:
        raise InvalidInput(f"page key {text[:60]!r} is not one of ours", "start at the first page")
    return int(text)
