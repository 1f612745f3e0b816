"""The base of all repositories: statements in pieces, get or insert, JSON columns, and page keys."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from datetime import datetime
from enum import StrEnum
from typing import Any, TypeVar, cast

from sqlalchemy import ColumnElement, Connection, CursorResult, Executable, Table, and_, insert, or_, select
from sqlalchemy.exc import IntegrityError

from slamhive.base.bounds import parse_json
from slamhive.base.errors import InvalidInput
from slamhive.store.tables import TableBase

T = TypeVar("T")
CHUNK = 500


class Repository:
    """Reads and writes through the connection of one transaction."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def _column(self, query: Any) -> list[Any]:
        """The first column of every row."""
        return list(self._connection.execute(query).scalars())

    def _number(self, query: Any) -> int:
        """The number that the query yields, such as a count."""
        return int(self._connection.execute(query).scalar_one())


def chunks(values: Sequence[T], size: int = CHUNK) -> Iterator[Sequence[T]]:
    """``values`` in pieces that are short enough for one statement."""
    for start in range(0, len(values), size):
        yield values[start : start + size]


def changed(connection: Connection, statement: Executable) -> int:
    """Execute an UPDATE or DELETE; how many rows it matched."""
    return cast("CursorResult[Any]", connection.execute(statement)).rowcount


def insert_many(
    connection: Connection,
    table: Table,
    names: Sequence[str],
    rows: Sequence[Sequence[Any]],
    as_stored: Collection[str] = (),
) -> None:
    """Insert rows, each with the values of the columns ``names``.

    SQLAlchemy takes a dictionary for each row and makes a list of it, which takes as long as the database needs.

    Args:
        connection: Of the transaction.
        table: Where the rows go.
        names: Columns of the table.
        rows: Values in the order of ``names``.
        as_stored: Columns whose values the database takes as they are; the others are converted.
    """
    if not rows:
        return
    dialect = connection.dialect
    converters = [
        None if name in as_stored else table.c[name].type.dialect_impl(dialect).bind_processor(dialect)
        for name in names
    ]
    if any(converters):
        rows = [
            [value if convert is None else convert(value) for value, convert in zip(row, converters, strict=True)]
            for row in rows
        ]
    quoted = ", ".join(map(dialect.identifier_preparer.quote, names))
    marks = ", ".join(["?" if dialect.paramstyle == "qmark" else "%s"] * len(names))
    text = f"INSERT INTO {dialect.identifier_preparer.format_table(table)} ({quoted}) VALUES ({marks})"  # noqa: S608 - names of the schema
    connection.exec_driver_sql(text, [tuple(row) for row in rows])


def get_or_insert(
    connection: Connection, table: type[TableBase], keys: Mapping[str, Any], values: Mapping[str, Any]
) -> tuple[int, bool]:
    """The id of the row with ``keys``, inserted with ``values`` if there is none; and whether it was inserted.

    Another transaction may insert the same row at the same time: the unique key decides, and the loser reads what the
    winner wrote. A violated key undoes only its statement, so no savepoint is needed. A savepoint would also hide a
    full disk or a deadlock, which undo the whole transaction.
    """
    columns = table.__table__.columns
    lookup = select(columns["id"]).where(*(columns[key] == value for key, value in keys.items()))
    found = connection.execute(lookup).scalar_one_or_none()
    if found is not None:
        return int(found), False
    try:
        result = cast("CursorResult[Any]", connection.execute(insert(table.__table__).values({**keys, **values})))
    except IntegrityError:
        return int(connection.execute(lookup).scalar_one()), False
    return int((result.inserted_primary_key or [None])[0]), True


def sample_variance(n: int, mean: float, mean_square: float) -> float:
    """The variance of a sample of ``n`` values, from their mean and the mean of their squares; 0 for a single value.

    ``E[x²] - E[x]²`` is the variance of a population; Bessel's factor ``n / (n - 1)`` makes it that of a sample. It is
    kept from falling below 0 by rounding. SQLite has no function for it.
    """
    return max(0.0, mean_square - mean**2) * n / max(1, n - 1)


def cut(text: str | None, length: int) -> str | None:
    """``text``, shortened to ``length`` characters if it is longer; an ellipsis marks the cut."""
    if text is None or len(text) <= length:
        return text
    return text[: length - 1] + "…"


def to_json(kind: Any, value: Any) -> Any:
    """A value of ``kind`` as JSON for a column; None for an absent or empty one."""
    if not value:
        return None
    from slamhive.documents.model import dump  # noqa: PLC0415 - most rows have none, and pydantic takes long to load

    return dump(kind, value)


# -- keys in addresses: the place where a page of a list ended, and the rows after it ----------------------------------

_LARGEST: dict[type, float] = {int: 2.0**63, float: math.inf}


def encode(values: Sequence[Any]) -> str:
    """The key of a row: the values that the list is sorted by."""
    plain = [value.isoformat() if isinstance(value, datetime) else value for value in values]
    return base64.urlsafe_b64encode(json.dumps(plain).encode()).decode().rstrip("=")


def decode(key: str, kinds: Sequence[type]) -> list[Any]:
    """The values of a key; the first may be None. Raises InvalidInput for a key of another kind of list."""
    try:
        values = parse_json(base64.urlsafe_b64decode(key + "=" * (-len(key) % 4)), "the page key")
    except (ValueError, InvalidInput):
        raise not_ours(key) from None
    if not isinstance(values, list) or len(values) != len(kinds):
        raise not_ours(key)
    return [
        None if value is None and place == 0 and len(values) > 1 else _checked(value, kind, key)
        for place, (value, kind) in enumerate(zip(values, kinds, strict=True))
    ]


def behind(columns: Sequence[ColumnElement[Any]], values: Sequence[Any], *, descending: bool) -> ColumnElement[bool]:
    """The rows after the one with ``values``; NULLs of the first column are last in both directions."""
    first, rest = columns[0], columns[1:]
    if not rest:
        return _further(first, values[0], descending=descending)
    inner = behind(rest, values[1:], descending=descending)
    if values[0] is None:
        return and_(first.is_(None), inner)
    return or_(_further(first, values[0], descending=descending), and_(first == values[0], inner), first.is_(None))


def ordered(columns: Sequence[ColumnElement[Any]], *, descending: bool) -> list[ColumnElement[Any]]:
    """The order of ``columns`` in one direction."""
    return [column.desc() if descending else column.asc() for column in columns]


def not_ours(key: str) -> InvalidInput:
    """The refusal of a key."""
    return InvalidInput(f"unknown page key {key[:60]!r}", "start at the first page")


def _further(column: ColumnElement[Any], value: Any, *, descending: bool) -> ColumnElement[bool]:
    found: ColumnElement[bool] = column < value if descending else column > value
    return found


def _checked(value: Any, kind: type, key: str) -> Any:
    if kind is datetime and isinstance(value, str):
        try:
            return datetime.fromisoformat(value)
        except ValueError:
            raise not_ours(key) from None
    if issubclass(kind, StrEnum) and value in list(kind):
        return kind(value)
    number = type(value) in {int, float} and math.isfinite(value) and abs(value) < _LARGEST[kind]
    if not (number if kind in _LARGEST else type(value) is kind) or (kind is int and type(value) is not int):
        raise not_ours(key)
    return value
