"""Keeps the statistics up to date that a database plans its queries with.

SQLite renews them on request only, so it would plan for a small file after the file has grown. MySQL and MariaDB renew
them when a tenth of a table has changed; after a bulk load we do not wait for that.
"""

from __future__ import annotations

from sqlalchemy import Connection, Engine, text

from slamhive.store.engine import writing

GROWTH = 1.25
"""Statistics are renewed when there are this many times the runs of the last time."""

_SAMPLED_ROWS = 1_000
_TABLES = ("runs", "configurations", "configuration_values", "metric_values")


def refresh_if_grown(engine: Engine) -> bool:
    """Renew the statistics if the tables have grown; whether they had. Cheap if they had not."""
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
    """How many runs the statistics of SQLite count; 0 if there are none."""
    exists = text("SELECT count(*) FROM sqlite_master WHERE name = 'sqlite_stat1'")
    if not connection.execute(exists).scalar_one():
        return 0
    rows = connection.execute(text("SELECT stat FROM sqlite_stat1 WHERE tbl = 'runs'")).scalars()
    return max((int(stat.split()[0]) for stat in rows if stat), default=0)
