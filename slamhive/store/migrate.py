"""Upgrades and downgrades the tables.

Every command asks for the revision of the tables. Loading Alembic takes longer than most commands, so that it is
loaded only where tables change.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import Connection, Engine, inspect, text

from slamhive.base.errors import Unavailable
from slamhive.store import (
    accounts,  # noqa: F401 - each adds its tables
    configuration_listing,  # noqa: F401 - each adds its tables
    models,  # noqa: F401 - each adds its tables
)
from slamhive.store.engine import database_label, sqlite_file, writing
from slamhive.store.tables import TableBase

if TYPE_CHECKING:
    from alembic.config import Config

LOCK_WAIT_S = 30
_MIGRATIONS = Path(__file__).parent / "migrations"
_VERSION_TABLE = "alembic_version"
METADATA = TableBase.metadata
"""All tables of this version. Importing the store itself loads only the tables that are read."""


def upgrade(engine: Engine, revision: str = "head") -> None:
    """Create the tables, or upgrade older ones to ``revision``. Two processes may try at once.

    Raises Unavailable if the tables were made by a newer version of the software.
    """
    found = current(engine)
    _check_not_newer(engine, found)
    if revision == "head" and found == head():
        return  # nearly every start: it needs neither Alembic nor the lock
    from alembic import command  # noqa: PLC0415

    with _locked(engine) as connection:
        command.upgrade(_config(connection), revision)


def downgrade(engine: Engine, revision: str = "base") -> None:
    """Downgrade the tables to ``revision``; ``base`` removes them and their content.

    A version that refuses stops the downgrade. SQLite is then unchanged. MySQL, where changing a table ends the
    transaction, is at the version that refused.
    """
    from alembic import command  # noqa: PLC0415

    steps = [revision]
    if engine.dialect.name != "sqlite":
        # One version at a time. A change of a table commits on MySQL, but the row with the version may not be committed
        # yet. If all versions went in one transaction, one that refuses would roll that row back.
        below = [*_revisions(), "base"]
        steps = below[below.index(current(engine) or "base") + 1 : below.index(revision) + 1]
    for step in steps:
        with _locked(engine) as connection:
            command.downgrade(_config(connection), step)


def current(engine: Engine) -> str | None:
    """The revision of the tables; None if there are none."""
    with engine.connect() as connection:
        if not inspect(connection).has_table(_VERSION_TABLE):
            return None
        return connection.execute(text(f"SELECT version_num FROM {_VERSION_TABLE}")).scalar()  # noqa: S608


def has_tables(engine: Engine) -> bool:
    """True if our tables exist, in any version. Asking makes no file."""
    if engine.dialect.name == "sqlite" and not sqlite_file(engine.url).is_file():
        return False
    return current(engine) is not None


def head() -> str:
    """The revision that this software needs."""
    return _revisions()[0]


def check_current(engine: Engine) -> None:
    """Raise Unavailable unless the tables are those of this software."""
    found = current(engine)
    _check_not_newer(engine, found)
    if found != head():
        state = "has no tables" if found is None else f"is at schema {found}, this version needs {head()}"
        raise Unavailable(
            f"database {database_label(engine)} {state}", "start the worker, or any writing command, once"
        )


@cache
def _revisions() -> tuple[str, ...]:
    """All revisions of the package, newest first: the numbers in the names of their files."""
    files = (_MIGRATIONS / "versions").glob("v[0-9]*_*.py")
    return tuple(sorted((path.name[1:].partition("_")[0] for path in files), reverse=True))


def _check_not_newer(engine: Engine, found: str | None) -> None:
    if found is not None and found not in _revisions():
        raise Unavailable(
            f"database {database_label(engine)} is at schema {found}, which is newer than this software ({head()})",
            "upgrade slamhive, or name another database",
        )


def _config(connection: Connection) -> Config:
    from alembic.config import Config  # noqa: PLC0415

    config = Config()
    config.set_main_option("script_location", str(_MIGRATIONS).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    return config


@contextmanager
def _locked(engine: Engine) -> Iterator[Connection]:
    """A connection in a transaction during which nobody else migrates the database."""
    if engine.dialect.name == "sqlite":
        with writing(engine).connect() as connection:
            driver = connection.connection.driver_connection
            if driver is None:
                raise AssertionError("an open connection has a driver connection")
            # SQLite changes a table by making it again, and removing the old one would violate the references to it.
            # The pragma does nothing inside a transaction, so it comes before BEGIN.
            driver.execute("PRAGMA foreign_keys=OFF")
            try:
                with connection.begin():  # DDL is transactional: the migration happens as a whole, or not at all
                    yield connection
            finally:
                driver.execute("PRAGMA foreign_keys=ON")
        return
    # MySQL commits before and after each change of a table, which releases locks of rows and tables. A named lock
    # belongs to the connection and outlives that. Names have at most 64 characters.
    name = f"slamhive-migrate-{engine.url.database}"[:64]
    with writing(engine).connect() as connection:
        taken = connection.execute(text("SELECT GET_LOCK(:name, :wait)"), {"name": name, "wait": LOCK_WAIT_S}).scalar()
        if taken != 1:
            raise Unavailable(
                f"database {database_label(engine)} has been migrated by another process for {LOCK_WAIT_S} s",
                "wait until it is done",
            )
        connection.commit()
        try:
            with connection.begin():
                yield connection
        finally:
            connection.execute(text("SELECT RELEASE_LOCK(:name)"), {"name": name})
            connection.commit()
