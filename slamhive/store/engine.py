"""An engine from a URL: SQLite (a file) for a workstation, MySQL 8 or MariaDB for a team."""

from __future__ import annotations

import sqlite3
from configparser import Error as ConfigurationError
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url, text
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from slamhive.base.errors import InvalidInput

BUSY_TIMEOUT_S = 5
CONNECT_TIMEOUT_S = 5
SOCKET_TIMEOUT_S = 60
LOCK_WAIT_S = 5
SQLITE_CACHE_KIB = 16_384
"""For each connection: it holds the upper pages of the indexes that a search over 100,000 runs reads."""
_WRITES = "slamhive_writes"
"""Execution option of connections that are going to write."""

_EXAMPLES = "use sqlite:////path/slamhive.db or mysql+pymysql://user:password@host/database"
_SQLITE_OPTIONS = ("timeout", "cached_statements", "check_same_thread")
_MYSQL_OPTIONS = (
    *("ssl_ca", "ssl_capath", "ssl_cert", "ssl_key", "ssl_key_password", "ssl_cipher"),
    *("ssl_check_hostname", "ssl_verify_cert", "ssl_verify_identity", "ssl_disabled"),
    *("unix_socket", "bind_address", "read_default_file", "read_default_group", "program_name"),
    *("charset", "connect_timeout", "read_timeout", "write_timeout"),
)
_MYSQL_SESSION = (
    "SET SESSION sql_mode='STRICT_ALL_TABLES,NO_ZERO_DATE,NO_ENGINE_SUBSTITUTION', "
    f"SESSION innodb_lock_wait_timeout={LOCK_WAIT_S}, time_zone='+00:00'"
)


def make_engine(database_url: str) -> Engine:
    """An engine for ``database_url``; nothing is connected yet.

    Raises InvalidInput for a URL that cannot be used, which includes an SQLite file in a folder that does not exist. No
    message contains the URL itself: it may hold a password.
    """
    url = _checked(database_url)
    # Each option is tried alone, without a connection: its name may be wrong, or its value.
    known = _SQLITE_OPTIONS if url.get_backend_name() == "sqlite" else _MYSQL_OPTIONS
    for name, value in url.query.items():
        if name not in known:
            remedy = f"leave it out; the options are {', '.join(known)}"
            raise InvalidInput(f"DATABASE_URL has the unknown option {name!r}", remedy)
        if not isinstance(value, str):
            raise InvalidInput(f"DATABASE_URL has the option {name!r} {len(value)} times", "leave out all but one")
        if name == "charset":
            continue  # replaced by the one that the tables have
        # A certificate is of use with its key only.
        together = {"ssl_cert", "ssl_key", "ssl_key_password"} if name.startswith("ssl_") else {name}
        alone = {key: url.query[key] for key in known if key in url.query and key in {name, *together}}
        try:
            tried = url.set(query=alone)
            _, options = tried.get_dialect()().create_connect_args(tried)
            if url.get_backend_name() == "sqlite":
                sqlite3.connect(":memory:", **options).close()
            else:
                import pymysql  # noqa: PLC0415 - SQLite needs none

                pymysql.Connection(defer_connect=True, **options)
        except (
            TypeError,
            ValueError,
            LookupError,
            ArithmeticError,
            OSError,
            ConfigurationError,
            SQLAlchemyError,
        ) as error:
            shown = name if "password" in name else f"{name}={value}"
            why = str(error.strerror if isinstance(error, OSError) and error.strerror else error).splitlines()
            said = f": {why[0]}" if why else ""
            raise InvalidInput(f"DATABASE_URL: the option {shown} cannot be used{said}", "correct it") from None
    if url.get_backend_name() == "sqlite":
        _check_file(sqlite_file(url))
        if "timeout" not in url.query:
            url = url.update_query_dict({"timeout": str(BUSY_TIMEOUT_S)})
        engine = create_engine(url, hide_parameters=True)

        # Readers work beside a writer (WAL), foreign keys are checked, and commits survive a power cut (FULL). A run
        # commits a dozen times in minutes, so nobody notices the fsync of each commit.
        @event.listens_for(engine, "connect")
        def configure(connection: Any, _record: Any) -> None:
            # Or the driver would begin transactions of its own, and never BEGIN IMMEDIATE.
            connection.isolation_level = None
            cache = f"cache_size=-{SQLITE_CACHE_KIB}"
            for statement in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", cache):
                connection.execute(f"PRAGMA {statement}")

        # A writer takes the lock at once. Of two read transactions that want to write later, each waits for the other
        # to end: SQLite fails one of them with SQLITE_BUSY at once, and no busy timeout helps.
        @event.listens_for(engine, "begin")
        def begin(connection: Connection) -> None:
            writes = connection.get_execution_options().get(_WRITES, False)
            connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

        return engine
    return create_engine(
        url.update_query_dict({"charset": "utf8mb4"}),
        pool_pre_ping=True,
        pool_recycle=3600,
        isolation_level="REPEATABLE READ",
        connect_args={
            "connect_timeout": CONNECT_TIMEOUT_S,
            "read_timeout": SOCKET_TIMEOUT_S,
            "write_timeout": SOCKET_TIMEOUT_S,
            "init_command": _MYSQL_SESSION,
        },
        hide_parameters=True,
    )


def writing(engine: Engine) -> Engine:
    """``engine`` for transactions that write.

    A reader sees one snapshot of the database (REPEATABLE READ). A writer must see what others have committed, because
    it compares and sets: the loser of a race has to see what the winner wrote. SQLite lets it take the only lock there
    is at once.
    """
    level = {"isolation_level": "READ COMMITTED"} if engine.dialect.name == "mysql" else {}
    return engine.execution_options(**{_WRITES: True}, **level)


def database_label(engine: Engine) -> str:
    """The database in words, without user or password: ``mysql lab:3306/slamhive``, ``sqlite /data/slamhive.db``."""
    url = engine.url
    if url.get_backend_name() == "sqlite":
        return f"sqlite {url.database}"
    port = "" if url.port is None else f":{url.port}"
    return f"mysql {url.host or 'localhost'}{port}/{url.database}"


def sqlite_file(url: URL) -> Path:
    """The file of an SQLite database."""
    return Path(url.database or "").absolute()


def log_of(engine: Engine) -> Path | None:
    """The write-ahead log of an SQLite database, which every commit changes; None for a database server."""
    return Path(f"{sqlite_file(engine.url)}-wal") if engine.dialect.name == "sqlite" else None


def _checked(database_url: str) -> URL:
    try:
        url = make_url(database_url)
    except (ArgumentError, ValueError):
        raise InvalidInput("DATABASE_URL is not a database URL", _EXAMPLES) from None
    if "\0" in (url.database or ""):
        raise InvalidInput(f"DATABASE_URL: {url.database!r} is not the name of a database", _EXAMPLES)
    if url.drivername in {"sqlite", "sqlite+pysqlite"}:
        if url.database in {None, "", ":memory:"} or url.query.get("mode") == "memory":
            raise InvalidInput(
                "DATABASE_URL names an in-memory SQLite database", "web server and worker share a file: " + _EXAMPLES
            )
        if url.host or url.username or url.password or url.port:
            raise InvalidInput("DATABASE_URL names a user or a server, but SQLite has a file", _EXAMPLES)
        return url
    if url.drivername in {"mysql", "mariadb", "mysql+pymysql", "mariadb+pymysql"}:
        if not url.database:
            raise InvalidInput("DATABASE_URL names no database on the server", _EXAMPLES)
        # These would raise only when a connection is opened, and no error of the database then.
        try:
            (url.host or "").encode("idna")
        except UnicodeError:
            raise InvalidInput(f"DATABASE_URL: {url.host!r} is not the name of a machine", _EXAMPLES) from None
        if url.port is not None and not 0 < url.port <= 65535:
            raise InvalidInput(f"DATABASE_URL: {url.port} is not a port", "use one from 1 to 65535, or leave it out")
        try:
            (url.password or "").encode("latin1")
        except UnicodeError:
            remedy = "give the account a password of Latin-1 letters"
            raise InvalidInput("DATABASE_URL: the password has letters that are not in Latin-1", remedy) from None
        return url.set(drivername="mysql+pymysql")
    raise InvalidInput(f"DATABASE_URL: {url.drivername!r} is not supported", _EXAMPLES)


def _check_file(path: Path) -> None:
    try:
        is_folder, has_folder = path.is_dir(), path.parent.is_dir()
    except OSError as error:  # too long, or in a folder of others
        raise InvalidInput(f"DATABASE_URL: {path} cannot be used: {error.strerror}", "name another file") from None
    if is_folder:
        raise InvalidInput(f"DATABASE_URL names the folder {path}", f"name a file in it: sqlite:///{path}/slamhive.db")
    if not has_folder:
        raise InvalidInput(f"the database's folder {path.parent} does not exist", "make it, or correct DATABASE_URL")


# -- the statistics that a database plans its queries with -------------------------------------------------------------

# SQLite renews them on request only, so it would plan for a small file after the file has grown. MySQL and MariaDB
# renew them when a tenth of a table has changed; after a bulk load we do not wait for that.

GROWTH = 1.25
"""Statistics are renewed when there are this many times the runs of the last time."""

_SAMPLED_ROWS = 1_000
_TABLES = ("runs", "configurations", "configuration_values", "metric_values")


def refresh_if_grown(engine: Engine) -> bool:
    """Renew the statistics if the tables have grown; returns True if they had. Cheap if they had not."""
    if engine.dialect.name != "sqlite":
        return False
    with engine.connect() as connection:
        grown = _newest(connection) > GROWTH * max(_known(connection), 1)
    if grown:
        refresh(engine)
    return grown


def refresh(engine: Engine) -> None:
    """Renew the statistics now; this takes milliseconds, however large the tables are."""
    with writing(engine).begin() as connection:
        if engine.dialect.name == "sqlite":
            connection.execute(text(f"PRAGMA analysis_limit={_SAMPLED_ROWS}"))
            connection.execute(text("ANALYZE"))
        else:
            connection.execute(text(f"ANALYZE TABLE {', '.join(_TABLES)}"))


def _newest(connection: Connection) -> int:
    return int(connection.execute(text("SELECT coalesce(max(id), 0) FROM runs")).scalar_one())


def _known(connection: Connection) -> int:
    """The number of runs that the statistics of SQLite count; 0 if there are none."""
    exists = text("SELECT count(*) FROM sqlite_master WHERE name = 'sqlite_stat1'")
    if not connection.execute(exists).scalar_one():
        return 0
    rows = connection.execute(text("SELECT stat FROM sqlite_stat1 WHERE tbl = 'runs'")).scalars()
    return max((int(stat.split()[0]) for stat in rows if stat), default=0)
