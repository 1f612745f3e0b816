"""The clock of the services."""

from __future__ import annotations

from datetime import UTC, datetime


def utc_now() -> datetime:
    """The time of now, with its time zone."""
    return datetime.now(UTC)
