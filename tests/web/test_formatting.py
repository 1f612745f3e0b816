"""How pages write numbers and times."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

from slamhive.domain.metrics import METRICS
from slamhive.web.formatting import DASH, display_unit, relative_time

NOW = datetime(2026, 5, 4, 12, 0, tzinfo=UTC)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (-3600 * 24 * 40, "2026-03-25"),
        (-3600 * 3, "3 h ago"),
        (-70, "1 min ago"),
        (-2, "just now"),
        (2, "just now"),
        (70, "in 1 min"),
        (3600 * 24 * 3, "in 3 d"),
        (3600 * 24 * 365 * 100, "2126-04-10"),
    ],
)
def test_times_lie_behind_or_ahead(seconds: float, words: str):
    assert relative_time(NOW + timedelta(seconds=seconds), NOW) == words


def test_no_time_is_a_dash():
    assert relative_time(None, NOW) == DASH


def test_every_share_is_shown_in_percent():
    for metric in METRICS.entries.values():
        is_share = metric.unit == "" and "share of the" in metric.definition.lower()[:32]
        assert (display_unit(metric).unit == "%") >= is_share, metric.key
