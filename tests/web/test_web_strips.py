"""Where strips draw values and failed runs."""

from __future__ import annotations

import pytest

from slamhive.web.small_plots import (
    FAILURES_FROM,
    FIRST,
    LAST,
    LAST_WITH_FAILURES,
    MOST_FAILURES,
    axis_of,
    failure_places,
)

pytestmark = pytest.mark.quick


def test_all_values_lie_on_the_axis_in_their_order() -> None:
    values = [0.031, 0.05, 0.042, 0.2]
    axis = axis_of(values, failures=False)
    assert axis is not None
    places = [axis.place(value) for value in sorted(values)]
    assert places == sorted(places)
    assert (places[0], places[-1]) == (FIRST, LAST)
    assert [value for _, value in axis.ticks] == pytest.approx([0.05, 0.1, 0.15, 0.2])
    assert [place for place, _ in axis.ticks] == [axis.place(value) for _, value in axis.ticks]


def test_failed_runs_lie_beside_the_axis() -> None:
    axis = axis_of([1.0, 2.0], failures=True)
    assert axis is not None
    assert axis.place(2.0) == LAST_WITH_FAILURES < FAILURES_FROM < min(failure_places(3))
    assert len(failure_places(100)) == MOST_FAILURES
    assert failure_places(0) == []


@pytest.mark.parametrize("values", [[0.01, 3.0], [1e-6, 1e6]])
def test_values_of_decades_have_a_logarithmic_axis(values: list[float]) -> None:
    axis = axis_of(values, failures=False)
    assert axis is not None
    assert axis.logarithmic
    assert 1 <= len(axis.ticks) <= 4
    assert all(FIRST <= place <= LAST for place, _ in axis.ticks)


@pytest.mark.parametrize("values", [[0.5], [0.0, 0.0], [-3.0, -3.0], [1e-9, 1.0000001e-9]])
def test_a_single_value_has_an_axis(values: list[float]) -> None:
    axis = axis_of(values, failures=False)
    assert axis is not None
    assert FIRST <= axis.place(values[0]) <= LAST


def test_without_values_there_is_no_axis() -> None:
    assert axis_of([], failures=True) is None
    assert axis_of([float("nan"), float("inf")], failures=True) is None
