"""The ids behind the names of a search: metrics, parameters and protocols."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sqlalchemy import Connection, func, or_, select

from slamhive.domain.parameters import ParameterType
from slamhive.errors import unknown
from slamhive.search.binding import Search
from slamhive.search.fields import VARIANT_PREFIX, Kind, ParameterKind, Source
from slamhive.search.grammar import leaves
from slamhive.store.models import MEASURED_PROTOCOL_ID, Metric, Parameter, Protocol, VariantOption

_KINDS = {
    ParameterType.INT: Kind.NUMBER,
    ParameterType.FLOAT: Kind.NUMBER,
    ParameterType.BOOL: Kind.FLAG,
    ParameterType.STRING: Kind.TEXT,
    ParameterType.ENUM: Kind.TEXT,
}


@dataclass(frozen=True, slots=True)
class Names:
    """The ids behind the names of a search and of the order of its list.

    ``parameters``: {key or general name: ids}. ``protocol_id``: the chosen protocol, None for each run's current one.
    ``glob``: whether the database has GLOB, else LIKE with a binary collation.
    """

    metrics: dict[str, int]
    parameters: dict[str, tuple[int, ...]]
    protocol_id: int | None
    glob: bool


def look_up(connection: Connection, search: Search, parameters: Iterable[str] = ()) -> Names:
    """The ids behind ``search`` and further ``parameters``; raises NotFound for an unknown protocol."""
    wanted = set(parameters)
    if search.tree is not None:
        wanted |= {leaf.field.name for leaf in leaves(search.tree) if leaf.field.source is Source.PARAMETER}
    return Names(
        metrics={row.key: row.id for row in connection.execute(select(Metric.key, Metric.id))},
        parameters=_parameter_ids(connection, wanted),
        protocol_id=None if search.protocol is None else _protocol_id(connection, search.protocol),
        glob=connection.dialect.name == "sqlite",
    )


def stored_parameters(connection: Connection) -> list[ParameterKind]:
    """Every parameter of any configuration, by key and by general name, and every option of variants.

    For matrices only ``has`` is useful: they are text that nothing equals.
    """
    found = []
    for key, general, kind, unit in connection.execute(
        select(Parameter.key, Parameter.general, Parameter.type, Parameter.unit).order_by(Parameter.id)
    ):
        meaning = _KINDS.get(ParameterType(kind), Kind.TEXT)
        found += [ParameterKind(name, meaning, unit) for name in dict.fromkeys((key, general)) if name is not None]
    options = select(VariantOption.name, func.count(VariantOption.number_value), func.count(VariantOption.text_value))
    for name, numbers, texts in connection.execute(options.group_by(VariantOption.name)):
        kinds = [Kind.NUMBER] * bool(numbers) + [Kind.TEXT] * bool(texts)
        found += [ParameterKind(VARIANT_PREFIX + name, kind) for kind in kinds]
    return found


def stored_protocols(connection: Connection) -> dict[str, str]:
    """{fingerprint: label} of all protocols."""
    query = select(Protocol.fingerprint, Protocol.label).where(Protocol.id != MEASURED_PROTOCOL_ID)
    return {row.fingerprint: row.label for row in connection.execute(query)}


def _parameter_ids(connection: Connection, names: set[str]) -> dict[str, tuple[int, ...]]:
    if not names:
        return {}
    table = Parameter.__table__
    found: dict[str, list[int]] = {name: [] for name in names}
    named = or_(table.c.key.in_(names), table.c.general.in_(names))
    for row in connection.execute(select(table.c.id, table.c.key, table.c.general).where(named)):
        for name in {row.key, row.general} & names:
            found[name].append(row.id)
    return {name: tuple(ids) for name, ids in found.items()}


def _protocol_id(connection: Connection, fingerprint: str) -> int:
    table = Protocol.__table__
    known = {row.fingerprint: row.id for row in connection.execute(select(table.c.fingerprint, table.c.id))}
    if fingerprint not in known:
        raise unknown("protocol", fingerprint, list(known))
    return int(known[fingerprint])
