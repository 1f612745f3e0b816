"""The one place that asks the machine for the time, and times as JSON has them.

``docs/design.md`` says which clock decides what.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime


def utc_now() -> datetime:
    """The wall clock, for what is recorded: when a run was submitted, started, ended."""
    return datetime.now(UTC)


def monotonic_s() -> float:
    """Seconds that never jump, for durations, deadlines and intervals."""
    return time.monotonic()


def timestamp(at: datetime | None) -> str | None:
    """ISO 8601 with the UTC offset, None for None."""
    return None if at is None else at.isoformat(timespec="milliseconds")


def exact(at: datetime | None) -> str | None:
    """The same to the microsecond, for records from which rows are rebuilt."""
    return None if at is None else at.isoformat()


@dataclass(frozen=True, slots=True)
class Clock:
    """All that a component asks of time, so that a test can hand in its own."""

    utc_now: Callable[[], datetime] = utc_now
    monotonic_s: Callable[[], float] = monotonic_s
    sleep: Callable[[float], None] = time.sleep


SYSTEM_CLOCK = Clock()
