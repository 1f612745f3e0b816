"""Units and orders are told from numbers, or left in doubt; never guessed."""

import numpy as np
import pytest

from slamhive.trajectory.evidence import Conclusion, find_order, find_unit, overlap
from slamhive.trajectory.layout import QuaternionOrder, TimeUnit

S, MS, US, NS = TimeUnit
XYZW, WXYZ = QuaternionOrder
TRUTH = (1403636580.0, 1403636700.0)
FROM_ZERO = (0.0, 120.0)


def times(first_s: float, step_s: float, unit: TimeUnit, count: int = 600) -> np.ndarray:
    return np.asarray((first_s + step_s * np.arange(count)) * unit.per_second, dtype=np.float64)


@pytest.mark.parametrize("unit", TimeUnit)
def test_dates_tell_the_unit(unit: TimeUnit) -> None:
    found = find_unit(times(1403636580.0, 0.2, unit), None, None)
    assert found.value is unit
    assert found.because == f"as {unit} the timestamps lie in 2014 and the poses 200 ms apart"


@pytest.mark.parametrize("unit", TimeUnit)
@pytest.mark.parametrize(("step_s", "count"), [(0.005, 24000), (0.05, 2400), (0.2, 600), (2.0, 60)])
def test_the_time_of_the_ground_truth_tells_the_unit(unit: TimeUnit, step_s: float, count: int) -> None:
    for truth in (FROM_ZERO, TRUTH):
        found = find_unit(times(truth[0], step_s, unit, count), None, truth)
        assert found.value is unit
        assert f"as {unit}" in found.because


@pytest.mark.parametrize("unit", [S, US, NS])
def test_a_short_estimate_is_told_by_the_time_between_poses(unit: TimeUnit) -> None:
    found = find_unit(times(0.0, 0.05, unit, 40), None, FROM_ZERO)
    assert found.value is unit
    assert found.because == f"only as {unit} are the poses a likely time apart, 50 ms"


def test_an_estimate_on_another_clock_is_not_bent_to_the_ground_truth() -> None:
    """As ms it would fall into the time of the ground truth, with poses 50 microseconds apart."""
    assert find_unit(times(1000.0, 0.05, S), None, (0.5, 120.0)).value is S


def test_where_two_units_are_likely_there_is_doubt_with_what_was_found() -> None:
    found = find_unit(np.arange(0.0, 500.0, 5.0), None, None)
    assert found == Conclusion(None, "the timestamps are 5 apart, which is 5 s if they are s, 5 ms if they are ms")


def test_surveyed_points_that_are_far_apart_are_not_taken_for_milliseconds() -> None:
    assert find_unit(times(1603366000.0, 40.0, S, 30), None, None).value is S
    found = find_unit(times(0.0, 40.0, S, 30), None, None)
    assert found == Conclusion(None, "the timestamps are 40 apart, which is 40 s if they are s, 40 ms if they are ms")
    assert find_unit(times(0.0, 40.0, S, 30), None, (0.0, 1200.0)).value is S


def test_where_no_unit_is_likely_there_is_doubt() -> None:
    assert find_unit(np.array([7.0, 7.0]), None, None).value is None
    found = find_unit(np.arange(0.0, 9e15, 1e15), None, None)
    assert found.value is None
    assert "1e+15 s if they are s" in found.because


def test_what_a_file_states_counts_unless_the_numbers_contradict() -> None:
    header = Conclusion(MS, "by its header")
    assert find_unit(np.arange(0.0, 500.0, 5.0), header, None) == header
    assert find_unit(times(0.0, 0.05, MS, 2400), header, FROM_ZERO) == header
    found = find_unit(times(1403636580.0, 0.05, NS), header, None)
    assert found.value is None
    assert found.because.startswith("ms by its header, but as ns the timestamps lie in 2014")


def test_spans_share_time() -> None:
    assert overlap((0, 10), (5, 15)) == pytest.approx(1 / 3)
    assert overlap((0, 10), (20, 30)) == 0
    assert overlap((0, 0), (0, 0)) == 0


TURNED = np.array([[0.5, 0.5, 0.5, 0.5], [0.1, 0.7, 0.1, 0.7]])


def test_the_ground_truth_tells_the_order() -> None:
    found = find_order(TURNED, None, {XYZW: 2.0, WXYZ: 140.0})
    assert found.value is XYZW
    assert found.because == (
        "the orientations agree with the ground truth to 2.0 deg read as xyzw, and to 140.0 deg read as wxyz"
    )


@pytest.mark.parametrize(
    "spreads", [{}, {XYZW: 3.0, WXYZ: 4.0}, {XYZW: 0.1, WXYZ: 0.3}, {XYZW: 1.0}, {XYZW: 30.0, WXYZ: 90.0}]
)
def test_an_order_that_nothing_tells_is_in_doubt(spreads: dict[QuaternionOrder, float]) -> None:
    assert find_order(TURNED, None, spreads).value is None
    stated = Conclusion(WXYZ, "by its header")
    assert find_order(TURNED, stated, spreads) == stated


def test_a_stated_order_that_the_ground_truth_contradicts_is_in_doubt() -> None:
    found = find_order(TURNED, Conclusion(WXYZ, "by --format euroc"), {XYZW: 2.0, WXYZ: 140.0})
    assert found.value is None
    assert found.because.startswith("wxyz by --format euroc, but the orientations agree with the ground truth")


def test_a_first_pose_without_rotation_tells_the_order() -> None:
    assert find_order(np.array([[0, 0, 0, 1.0]]), None, {}).value is XYZW
    assert find_order(np.array([[-1.0, 0, 0, 0]]), None, {}).value is WXYZ
