"""Tests do not wait for the disk: fsync protects from power cuts, and none of them cuts the power.

It takes milliseconds, and tests write ten thousands of times. A killed process loses nothing either, so what is
forked for tests goes without it, too; other processes wait as they always do.
"""

from __future__ import annotations

import os
import sqlite3
import sys
from typing import Any

_fsync = os.fsync
_left_out = False
_listening = False


def leave_out(wanted: bool) -> None:
    """Whether this process goes without fsync from now on, in files and in SQLite."""
    global _left_out, _listening  # noqa: PLW0603 - there is one process, and one os.fsync
    _left_out = wanted
    if wanted and not _listening and "sqlalchemy" in sys.modules:
        from sqlalchemy import Pool, event  # noqa: PLC0415 - loading it takes longer than all unit tests

        event.listen(Pool, "checkout", _settle)
        _listening = True
    os.fsync = _fsync_if_wanted  # type: ignore[assignment]


def _fsync_if_wanted(descriptor: int) -> None:
    if not _left_out:
        _fsync(descriptor)


def _settle(connection: Any, record: Any, _proxy: object) -> None:
    """SLAM Hive has chosen FULL for a new connection."""
    wanted = "OFF" if _left_out else "FULL"
    if isinstance(connection, sqlite3.Connection) and record.info.get("synchronous", "FULL") != wanted:
        connection.execute(f"PRAGMA synchronous={wanted}")
        record.info["synchronous"] = wanted
