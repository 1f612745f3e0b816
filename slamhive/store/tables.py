"""Declares tables: one class each, whose attributes are the columns.

The columns are those of SQLAlchemy Core. Its object-relational mapper would take half as long to import as the rest of
a command that lists runs, and adds to each statement; no query here asks for objects.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, ClassVar, TypeVar, cast

from sqlalchemy import Column, ColumnClause, DateTime, Dialect, Enum, MetaData, Table, Text
from sqlalchemy.dialects.mysql import DATETIME, DOUBLE, MEDIUMTEXT
from sqlalchemy.types import Double, TypeDecorator, TypeEngine

T = TypeVar("T")

TABLE_OPTIONS = {"mysql_engine": "InnoDB", "mysql_charset": "utf8mb4", "mysql_collate": "utf8mb4_bin"}
"""Binary collation: MySQL must distinguish ``nFeatures`` and ``nfeatures``, as SQLite does."""


class TableBase:
    """A table. Every constraint has a name, so that a migration can drop it.

    A class can stand in a query wherever its table can.
    """

    metadata: ClassVar[MetaData] = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    __tablename__: ClassVar[str]
    __table_args__: ClassVar[tuple[Any, ...]] = (TABLE_OPTIONS,)
    """Indexes and constraints of several columns, then the options of the table."""
    __table__: ClassVar[Table]

    def __init_subclass__(cls) -> None:
        columns: list[Column[Any]] = []
        for name, value in vars(cls).items():
            if isinstance(value, Column):
                value.name = value.key = name
                columns.append(value)
        *parts, options = cls.__table_args__
        cls.__table__ = Table(cls.__tablename__, cls.metadata, *columns, *parts, **options)

    @classmethod
    def __clause_element__(cls) -> Table:
        """The table, where SQLAlchemy is given the class."""
        return cls.__table__


def column(kind: TypeEngine[T] | type[TypeEngine[T]], *parts: Any, **options: Any) -> ColumnClause[T]:
    """A column that always has a value. ``parts`` and ``options`` are those of a Column."""
    return Column(kind, *parts, nullable=False, **options)


def optional(kind: TypeEngine[T] | type[TypeEngine[T]], *parts: Any, **options: Any) -> ColumnClause[T | None]:
    """A column whose value may be missing."""
    return Column(kind, *parts, nullable=True, **options)


# -- column types that mean the same on SQLite and on MySQL / MariaDB --------------------------------------------------

E = TypeVar("E", bound=StrEnum)

as_json = json.JSONEncoder(allow_nan=False, separators=(",", ":")).encode
"""Text of a value in such a column; raises ValueError for NaN. One encoder for all: an experiment stores a million."""

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


from_json = json.JSONDecoder().decode
"""Reads the text of such a column. ``json.loads`` looks at its options for each value."""


class JsonText(TypeDecorator[Any]):
    """A JSON value kept as text.

    We avoid the native type: MySQL's reorders keys, and MariaDB has none. Only the count of runs by node looks inside.
    """

    impl = LongText
    cache_ok = True

    def process_bind_param(self, value: Any, dialect: Dialect) -> str | None:  # noqa: ARG002
        """To text; None becomes NULL, NaN is refused."""
        return None if value is None else as_json(value)

    def process_result_value(self, value: str | None, dialect: Dialect) -> Any:  # noqa: ARG002
        """Back to the value."""
        return None if value is None else from_json(value)


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
