"""Upgrades and downgrades the tables."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine, text

from slamhive.errors import Unavailable
from slamhive.store.engine import database_label, sqlite_file, writing

LOCK_WAIT_S = 30


def upgrade(engine: Engine, revision: str = "head") -> None:
    """Create the tables, or upgrade older ones to ``revision``. Two processes may try at once.

    Raises Unavailable if the tables were made by a newer version of the software.
    """
    found = current(engine)
    _check_not_newer(engine, found)
    if revision == "head" and found == head():
        return
    with _locked(engine) as connection:
        command.upgrade(_config(connection), revision)


def downgrade(engine: Engine, revision: str = "base") -> None:
    """Downgrade the tables to ``revision``; ``base`` removes them and their content.

    A version that refuses stops the downgrade. SQLite is then unchanged. MySQL, where changing a table ends the
    transaction, is at the version that refused.
    """
    steps = [revision] if engine.dialect.name == "sqlite" else _downwards(current(engine), revision)
    for step in steps:
        with _locked(engine) as connection:
            command.downgrade(_config(connection), step)


def current(engine: Engine) -> str | None:
    """The revision of the tables; None if there are none."""
    with engine.connect() as connection:
        return MigrationContext.configure(connection).get_current_revision()


def has_tables(engine: Engine) -> bool:
    """Whether our tables exist, in any version. Asking makes no file."""
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
    """All revisions of the package, newest first."""
    return tuple(script.revision for script in ScriptDirectory.from_config(_config(None)).walk_revisions())


def _downwards(found: str | None, revision: str) -> list[str]:
    """The revisions from the one below ``found`` down to ``revision``."""
    below = [*_revisions(), "base"]
    return below[below.index(found or "base") + 1 : below.index(revision) + 1]


def _check_not_newer(engine: Engine, found: str | None) -> None:
    if found is not None and found not in _revisions():
        raise Unavailable(
            f"database {database_label(engine)} is at schema {found}, which is newer than this software ({head()})",
            "upgrade slamhive, or name another database",
        )


def _config(connection: Connection | None) -> Config:
    config = Config()
    folder = Path(__file__).parent / "migrations"
    config.set_main_option("script_location", str(folder).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    return config


@contextmanager
def _locked(engine: Engine) -> Iterator[Connection]:
    """A connection in a transaction during which nobody else migrates the database."""
    if engine.dialect.name == "sqlite":
        with _locked_sqlite(engine) as connection:
            yield connection
        return
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


@contextmanager
def _locked_sqlite(engine: Engine) -> Iterator[Connection]:
    """SQLite's DDL is transactional, so a migration fails as a whole. Rebuilding tables needs foreign keys off."""
    with writing(engine).connect() as connection:
        driver = connection.connection.driver_connection
        if driver is None:
            raise AssertionError("an open connection has a driver connection")
        driver.execute("PRAGMA foreign_keys=OFF")
        try:
            with connection.begin():
                yield connection
        finally:
            driver.execute("PRAGMA foreign_keys=ON")
