"""Times and parameter values as JSON has them."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from slamhive.domain.parameters import Value


def timestamp(at: datetime | None) -> str | None:
    """ISO 8601 with the UTC offset, None for None."""
    return None if at is None else at.isoformat(timespec="milliseconds")


def exact(at: datetime | None) -> str | None:
    """The same to the microsecond, for what a row is rebuilt from."""
    return None if at is None else at.isoformat()


def plain(value: Value) -> Any:
    """A parameter value as JSON has it."""
    return list(value) if isinstance(value, tuple) else value
