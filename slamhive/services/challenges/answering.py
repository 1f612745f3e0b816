"""When results are shown. The time of an answer must not tell how long anything took."""

from __future__ import annotations

from datetime import datetime, timedelta

ANSWERS_EVERY = timedelta(minutes=1)
"""Of trajectories: how long an evaluation takes depends on both trajectories."""


def shown_at(now: datetime, every_h: int | None) -> datetime:
    """The next full minute; with ``every_h``, the next multiple of so many hours of the day (UTC)."""
    if every_h is None:
        return now.replace(second=0, microsecond=0) + ANSWERS_EVERY
    midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
    return midnight + timedelta(hours=every_h * (now.hour // every_h + 1))
