"""A new SQLite database gets its tables from one that was migrated: migrating takes a tenth of a second of CPU time.

Tests make thousands of databases. All migrations run once in a test run; the statements that make the same tables,
and their first rows, are shared by all processes.
"""

from __future__ import annotations

import json
import sqlite3
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.sharing import made_once

if TYPE_CHECKING:
    from sqlalchemy import Engine

_migrated: Any = None
"""What :mod:`slamhive.store.migrate` calls ``upgrade``, once it was replaced here."""


def copy_tables() -> None:
    """From now on this process copies the tables of new SQLite databases."""
    global _migrated  # noqa: PLW0603 - there is one process, and one way to upgrade
    migrate: Any = sys.modules.get("slamhive.store.migrate")  # loading it takes longer than all unit tests
    if _migrated is None and hasattr(migrate, "upgrade"):
        _migrated = migrate.upgrade
        _statements()  # now: a test may empty the environment, which names the folder where they are
        migrate.upgrade = upgrade


@contextmanager
def migrated_tables() -> Iterator[None]:
    """In the block, new databases are migrated, as they always are outside tests."""
    from slamhive.store import migrate  # noqa: PLC0415

    before, migrate.upgrade = migrate.upgrade, _migrated or migrate.upgrade
    try:
        yield
    finally:
        migrate.upgrade = before


def upgrade(engine: Engine, revision: str = "head") -> None:
    """Take the place of :func:`slamhive.store.migrate.upgrade`, which does what this does not."""
    from sqlalchemy import inspect  # noqa: PLC0415

    from slamhive.store import migrate  # noqa: PLC0415
    from slamhive.store.engine import sqlite_file  # noqa: PLC0415

    if engine.dialect.name == "sqlite" and revision == "head":
        path = sqlite_file(engine.url)
        if not path.exists() or path.stat().st_size == 0:
            statements = _statements()
            with migrate._locked(engine) as connection:
                if not inspect(connection).get_table_names():  # nobody else was faster
                    for statement in statements:
                        connection.exec_driver_sql(statement)
            return
    _migrated(engine, revision)


@cache
def _statements() -> list[str]:
    """What makes the tables of a new database and its rows."""
    folder = made_once("tables", _note_statements)
    return list(json.loads((folder / "statements.json").read_text()))


def _note_statements(folder: Path) -> None:
    from slamhive.store.engine import make_engine  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as aside:
        path = Path(aside, "migrated.db")
        engine = make_engine(f"sqlite:///{path}")
        _migrated(engine)
        engine.dispose()
        with closing(sqlite3.connect(path)) as connection:
            dumped = [line for line in connection.iterdump() if line.startswith(("CREATE ", "INSERT "))]
    folder.mkdir()
    (folder / "statements.json").write_text(json.dumps(dumped))
