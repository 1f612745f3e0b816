"""How tables are written down: one class each, whose attributes are the columns.

The columns are those of SQLAlchemy Core. Its object-relational mapper would take half as long to import as the rest of
a command that lists runs, and adds to each statement; no query here asks for objects.
"""

from __future__ import annotations

from typing import Any, ClassVar, TypeVar

from sqlalchemy import Column, ColumnClause, MetaData, Table
from sqlalchemy.types import TypeEngine

T = TypeVar("T")

TABLE_OPTIONS = {"mysql_engine": "InnoDB", "mysql_charset": "utf8mb4", "mysql_collate": "utf8mb4_bin"}
"""Binary collation: MySQL must distinguish ``nFeatures`` and ``nfeatures``, as SQLite does."""


class Base:
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
