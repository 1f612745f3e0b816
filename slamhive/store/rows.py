"""What all repositories share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar, cast

from sqlalchemy import Connection, CursorResult, Executable, insert, select
from sqlalchemy.exc import IntegrityError

from slamhive.store.tables import Base

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


def get_or_insert(
    connection: Connection, table: type[Base], keys: Mapping[str, Any], values: Mapping[str, Any]
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


def cut(text: str | None, length: int) -> str | None:
    """``text``, shortened to ``length`` characters if it is longer; an ellipsis marks the cut."""
    if text is None or len(text) <= length:
        return text
    return text[: length - 1] + "…"


def to_json(kind: Any, value: Any) -> Any:
    """A value of ``kind`` as JSON for a column; None for an absent or empty one."""
    if not value:
        return None
    from slamhive.schema.model import dump  # noqa: PLC0415 - most rows have none, and pydantic takes long to load

    return dump(kind, value)


def from_json(kind: type[T], content: Any) -> T:
    """The value that :func:`to_json` wrote as ``content``."""
    from slamhive.schema.model import load  # noqa: PLC0415 - see above

    return load(kind, content)
