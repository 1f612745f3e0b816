"""Times and parameter values in JSON."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from slamhive.domain.parameters import Value


def timestamp(at: datetime | None) -> str | None:
    """ISO 8601 with the UTC offset, None for None."""
    return None if at is None else at.isoformat(timespec="milliseconds")


def exact(at: datetime | None) -> str | None:
    """The same to the microsecond, for records from which rows are rebuilt."""
    return None if at is None else at.isoformat()


def plain(value: Value) -> Any:
    """A parameter value in JSON."""
    return list(value) if isinstance(value, tuple) else value
