"""Errors of the database: whether another attempt may help, and one line for the user."""

from __future__ import annotations

import shutil
import sqlite3

from sqlalchemy import Engine
from sqlalchemy.exc import DBAPIError, InterfaceError

from slamhive.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.store.engine import database_label, sqlite_file

FULL_DISK_BYTES = 1_000_000
"""With less free space than this, a failed access to an SQLite file means a full disk: files grow in pages."""

_SQLITE_TRANSIENT = {
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_PROTOCOL,
}
_SQLITE_FINAL: dict[int, tuple[str, str]] = {
    sqlite3.SQLITE_FULL: ("cannot grow, the disk is full", "free space; nothing that was stored is lost"),
    sqlite3.SQLITE_READONLY: ("is read-only", "check the rights of the file and of its folder"),
    sqlite3.SQLITE_CORRUPT: ("is damaged", "move the file away and run: slamhive reindex"),
    sqlite3.SQLITE_NOTADB: ("is not an SQLite database", "check DATABASE_URL"),
}
_MYSQL_TRANSIENT = {
    1040: "too many connections",
    1053: "the server is shutting down",
    1205: "lock wait timeout",
    1213: "deadlock, the other transaction won",
    1927: "connection was killed",
    2002: "cannot connect (socket)",
    2003: "cannot connect (TCP)",
    2006: "server has gone away",
    2013: "connection lost during a query",
    2014: "commands out of sync after an interrupted query",
    4031: "disconnected for inactivity",
}
_MYSQL_FINAL: dict[int, tuple[type[SlamHiveError], str, str]] = {
    1021: (Unavailable, "cannot grow, the server's disk is full", "free space; nothing that was stored is lost"),
    1044: (InvalidInput, "refuses the user", "grant the user all rights on the database"),
    1045: (InvalidInput, "refuses the user or the password", "check DATABASE_URL"),
    1049: (InvalidInput, "does not exist", "create it: CREATE DATABASE name CHARACTER SET utf8mb4"),
    1114: (Unavailable, "cannot grow, a table is full", "free space; nothing that was stored is lost"),
    1290: (Unavailable, "is read-only", "make the server writable"),
    1698: (InvalidInput, "refuses the user", "check DATABASE_URL"),
    1836: (Unavailable, "is read-only", "make the server writable"),
}


def error_code(error: DBAPIError) -> int | None:
    """The database's own error number; SQLite's primary result code. None where there is none."""
    original = error.orig
    if isinstance(original, sqlite3.Error):
        code = getattr(original, "sqlite_errorcode", None)
        return None if code is None else code & 0xFF
    arguments = getattr(original, "args", ())
    return arguments[0] if arguments and isinstance(arguments[0], int) else None


def is_transient(engine: Engine, error: DBAPIError) -> bool:
    """Whether the same transaction may succeed a moment later: a lock, a deadlock, a server that is away."""
    if isinstance(error.orig, sqlite3.Error):
        return error_code(error) in _SQLITE_TRANSIENT and not _is_full_disk(engine, error)
    return isinstance(error, InterfaceError) or error.connection_invalidated or error_code(error) in _MYSQL_TRANSIENT


def explained(engine: Engine, error: DBAPIError) -> SlamHiveError | None:
    """The line for the user if the error is one that a user can cause; None for a bug."""
    label = database_label(engine)
    code = error_code(error)
    if isinstance(error.orig, sqlite3.Error) and _is_full_disk(engine, error):
        code = sqlite3.SQLITE_FULL
    if code is not None and isinstance(error.orig, sqlite3.Error) and code in _SQLITE_FINAL:
        what, remedy = _SQLITE_FINAL[code]
        return Unavailable(f"database {label} {what}", remedy)
    if code in _MYSQL_FINAL:
        kind, what, remedy = _MYSQL_FINAL[code]
        return kind(f"database {label} {what}", remedy)
    return None


def _is_full_disk(engine: Engine, error: DBAPIError) -> bool:
    """Whether a failed access is that of a full disk, which SQLite reports as an I/O error or as a file it cannot open.

    The index of the write-ahead log is mapped into memory: even a reader needs a page of disk for it.
    """
    if error_code(error) not in {sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN}:
        return False
    try:
        return shutil.disk_usage(sqlite_file(engine.url).parent).free < FULL_DISK_BYTES
    except OSError:
        return False


def gave_up(engine: Engine, error: DBAPIError, waited_s: float) -> Unavailable:
    """The line for a database that stayed locked or away during the whole wait."""
    sqlite = isinstance(error.orig, sqlite3.Error)
    remedy = (
        "see which other program holds the file open, and whether its disk is there"
        if sqlite
        else "see whether the server runs and can be reached, then try again"
    )
    return Unavailable(
        f"database {database_label(engine)} does not answer since {waited_s:.0f} s: {short(error)}",
        f"nothing that was stored is lost; {remedy}",
    )


def short(error: DBAPIError) -> str:
    """The driver's message in one line, without statement and parameters."""
    arguments = getattr(error.orig, "args", ())
    text = str(arguments[-1]) if arguments else type(error.orig).__name__
    return " ".join(text.split())[:200]
