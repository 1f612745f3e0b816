"""How pages write numbers and times."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

from slamhive.domain.metrics import METRICS
from slamhive.web.formatting import DASH, display_unit, mean_text, metric_cell, relative_time

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


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.10612, "0.106"),
        (12.345, "12.3"),
        (123.45, "123"),
        (1234.5, "1,234"),
        (0.0, "0"),
        (2.0, "2"),
        (4e-5, "4.00e-05"),
    ],
)
def test_lists_show_three_digits_and_the_exact_value_on_hover(value: float, text: str):
    cell = metric_cell(METRICS.entries["ate.rmse"], value)
    assert (cell.text, cell.exact) == (text, f"{value!r} m")


def test_a_mean_has_three_digits_and_its_deviation_two():
    assert mean_text(0.10612, 0.01934) == "0.106 ± 0.019"


@pytest.mark.parametrize(
    ("std", "text"),
    [
        (3e-6, "0.0191 ± 3.0e-06"),
        (0.0, "0.0191 ± 0"),
        (1e-15, "0.0191 ± 0"),
        (None, "0.0191"),
        (4e-4, "0.0191 ± 0.0004"),
    ],
)
def test_a_small_deviation_is_not_shown_as_a_row_of_zeros(std: float | None, text: str):
    assert mean_text(0.0191, std) == text


def test_every_share_is_shown_in_percent():
    for metric in METRICS.entries.values():
        is_share = metric.unit == "" and "share of the" in metric.definition.lower()[:32]
        assert (display_unit(metric).unit == "%") >= is_share, metric.key
