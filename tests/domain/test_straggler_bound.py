"""The bound for schedulers without foresight, compared with all schedules of a few runs and with schedulers."""

from __future__ import annotations

import heapq
import itertools
import math
import random
from collections.abc import Iterator, Sequence
from statistics import fmean

import numpy as np
import pytest

from benchmarks.straggler_bound import Law, expected_end_at_least_s, least_risk

pytestmark = pytest.mark.integration

LAW = Law(0.2, 1.5, 3.0)


def schedules(runs_s: Sequence[float], nodes: int) -> Iterator[list[list[float]]]:
    """Each way to give runs in some order to nodes."""
    for order in itertools.permutations(runs_s):
        for cuts in itertools.combinations_with_replacement(range(len(order) + 1), nodes - 1):
            edges = (0, *cuts, len(order))
            yield [list(order[begin:end]) for begin, end in itertools.pairwise(edges)]


def risk_of(schedule: list[list[float]], end_s: float) -> float | None:
    """R of a schedule in which no node pauses before its runs are over; None if it ends later."""
    risk = 0.0
    for runs_s in schedule:
        start_s = 0.0
        for run_s in runs_s:
            if start_s + run_s > end_s:
                return None
            risk += float(LAW.risk(np.array((end_s - start_s) / run_s)))
            start_s += run_s
    return risk


@pytest.mark.parametrize(
    ("runs_s", "nodes", "end_s"),
    [
        ([10.0], 1, 10.0),
        ([10.0], 1, 20.0),
        ([10.0, 10.0], 1, 20.0),
        ([20.0, 40.0, 10.0, 5.0], 1, 90.0),
        ([20.0, 40.0, 10.0, 5.0, 30.0], 2, 70.0),
        ([20.0, 40.0, 10.0, 5.0, 30.0], 2, 55.0),
        ([20.0, 40.0, 10.0, 5.0, 30.0, 12.0], 3, 60.0),
    ],
)
def test_no_schedule_risks_less(runs_s: list[float], nodes: int, end_s: float) -> None:
    found = [risk for schedule in schedules(runs_s, nodes) if (risk := risk_of(schedule, end_s)) is not None]
    bound = least_risk(runs_s, nodes, end_s, LAW)
    assert bound <= min(found) + 1e-9
    assert bound >= 0.6 * min(found) - 1e-9, "the bound says something"


def test_where_not_all_runs_fit_the_chance_is_almost_nothing() -> None:
    assert math.exp(-least_risk([10.0, 10.0, 10.0], 1, 20.0, LAW)) < 0.02


def test_long_after_the_end_there_is_no_risk() -> None:
    assert least_risk([10.0, 20.0, 30.0], 2, 500.0, LAW) == pytest.approx(0.0, abs=1e-6)


def end_s(order: Sequence[float], nodes: int, draw: random.Random) -> float:
    """When a queue in this order ends; a free node takes the next run."""
    free = [0.0] * nodes
    for run_s in order:
        late = draw.random() < LAW.fraction
        taken_s = run_s * (draw.uniform(LAW.least, LAW.most) if late else 1.0)
        heapq.heappush(free, heapq.heappop(free) + taken_s)
    return max(free)


@pytest.mark.parametrize("nodes", [1, 3])
def test_schedulers_without_foresight_are_later_on_average(nodes: int) -> None:
    runs_s = [60.0, 45.0, 45.0, 40.0, 30.0, 25.0, 20.0, 20.0, 10.0, 10.0, 5.0, 5.0]
    earliest_s = max(60.0, sum(runs_s) / nodes)
    bound_s = expected_end_at_least_s(runs_s, nodes, earliest_s, LAW)
    for order in (runs_s, runs_s[::-1]):
        draw = random.Random(3)
        assert fmean(end_s(order, nodes, draw) for _ in range(4000)) > 0.99 * bound_s
    assert bound_s > earliest_s
