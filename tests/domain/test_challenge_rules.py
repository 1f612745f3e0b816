"""Phases, and what the value of a sequence counts."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from slamhive.domain.challenge import PhaseState, Rule, Scoring, phase_state, rounded, shown

NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)
EVENING = datetime(2026, 5, 4, 18, tzinfo=UTC)


@pytest.mark.parametrize(
    ("begins", "ends", "now", "state"),
    [
        (None, None, NOON, PhaseState.OPEN),
        (EVENING, None, NOON, PhaseState.COMING),
        (NOON, EVENING, NOON, PhaseState.OPEN),
        (NOON, EVENING, EVENING, PhaseState.ENDED),
        (EVENING, NOON, NOON, PhaseState.ENDED),  # closed before it began
    ],
)
def test_a_phase_is_open_from_its_beginning_until_its_end(begins, ends, now, state):
    assert phase_state(begins, ends, now) is state


def test_values_have_so_many_significant_digits():
    assert [rounded(value, 3) for value in (0.0123456, 123456.0, 0.0)] == [0.0123, 123000.0, 0.0]
    assert [shown(value, 3) for value in (0.11, 123.0, 66.7, 0.0)] == ["0.110", "123", "66.7", "0.00"]


def test_a_failed_sequence_counts_as_the_worst_value_and_none_counts_as_worse():
    errors = Scoring(Rule.MEAN, 1.0, higher_is_better=False)
    assert [errors.points(value) for value in (0.2, 3.0, None)] == [0.2, 1.0, 1.0]
    shares = Scoring(Rule.MEAN, 0.1, higher_is_better=True)
    assert [shares.points(value) for value in (0.9, 0.0, None)] == [0.9, 0.1, 0.1]
    assert errors.is_better(0.1, 0.2)
    assert shares.is_better(0.2, 0.1)


def test_an_area_grows_as_errors_shrink():
    area = Scoring(Rule.AREA, 0.1, higher_is_better=False)
    assert [area.points(value) for value in (0.0, 0.025, 0.1, 7.0, None)] == pytest.approx([100, 75, 0, 0, 0])
    assert area.is_better(80, 70)


def test_a_needed_value_that_is_missing_counts_nothing():
    assert Scoring(Rule.POOLED, None, higher_is_better=False).points(None) is None
