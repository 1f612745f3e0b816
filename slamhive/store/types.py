"""Column types that mean the same on SQLite and on MySQL / MariaDB."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, TypeVar, cast

from sqlalchemy import DateTime, Dialect, Enum, Text
from sqlalchemy.dialects.mysql import DATETIME, DOUBLE, MEDIUMTEXT
from sqlalchemy.types import Double, TypeDecorator, TypeEngine

E = TypeVar("E", bound=StrEnum)

_as_json = json.JSONEncoder(allow_nan=False, separators=(",", ":")).encode
"""One encoder for all values: an experiment stores a million."""

LongText = Text().with_variant(MEDIUMTEXT(), "mysql")
"""Text of up to 16 MB."""

Number: TypeEngine[float] = Double().with_variant(DOUBLE(asdecimal=False), "mysql")
"""A 64-bit float."""


class UtcDateTime(TypeDecorator[datetime]):
    """An aware datetime, stored as UTC with microseconds; a naive one is a bug and refused."""

    impl = DateTime().with_variant(DATETIME(fsp=6), "mysql")
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        """To naive UTC, which both databases store."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"{value!r} has no time zone; the store takes aware datetimes only")
        return value.astimezone(UTC).replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        """Back to an aware datetime."""
        return None if value is None else value.replace(tzinfo=UTC)


class JsonText(TypeDecorator[Any]):
    """A JSON value kept as text.

    We avoid the native type: MySQL's reorders keys, and MariaDB has none. Only the count of runs by node looks inside.
    """

    impl = LongText
    cache_ok = True

    def process_bind_param(self, value: Any, dialect: Dialect) -> str | None:  # noqa: ARG002
        """To text; None becomes NULL, NaN is refused."""
        return None if value is None else _as_json(value)

    def process_result_value(self, value: str | None, dialect: Dialect) -> Any:  # noqa: ARG002
        """Back to the value."""
        return None if value is None else json.loads(value)


def enum_column(kind: type[E]) -> TypeEngine[E]:
    """A column that holds the values of ``kind`` as plain text, so that a new member needs no migration."""
    made: Any = Enum(
        kind,
        native_enum=False,
        create_constraint=False,
        length=32,
        values_callable=lambda members: [member.value for member in members],
    )
    return cast("TypeEngine[E]", made)
