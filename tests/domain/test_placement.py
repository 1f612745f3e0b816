"""Schedules of runs on nodes, and the bound that none can beat."""

from __future__ import annotations

import itertools
import random

import pytest

from slamhive.domain.placement import DataRuns, NodePlan, lower_bound_s, makespan_s, place


def group(data: str, transfer_s: float, *durations_s: float) -> DataRuns:
    """Runs on the same data."""
    return DataRuns(data, transfer_s, durations_s)


def best_s(groups: list[DataRuns], nodes: int) -> float:
    """The shortest schedule of all, by trying each."""
    runs = [(entry, duration_s) for entry in groups for duration_s in entry.durations_s]
    found = float("inf")
    for nodes_of_runs in itertools.product(range(nodes), repeat=len(runs)):
        ends_s = [0.0] * nodes
        held: set[tuple[int, str]] = set()
        for node, (entry, duration_s) in zip(nodes_of_runs, runs, strict=True):
            ends_s[node] += duration_s + (0.0 if (node, entry.data) in held else entry.transfer_s)
            held.add((node, entry.data))
        found = min(found, max(ends_s))
    return found


def check_complete(plans: list[NodePlan], groups: list[DataRuns]) -> None:
    """Each run is there once, and each node gets the data of its runs once."""
    placed = sorted((run.data, run.index, run.duration_s) for plan in plans for run in plan.runs)
    given = sorted((entry.data, index, each) for entry in groups for index, each in enumerate(entry.durations_s))
    assert placed == given
    transfers_s = {entry.data: entry.transfer_s for entry in groups}
    for plan in plans:
        assert sorted(plan.data) == sorted({run.data for run in plan.runs})
        busy_s = sum(run.duration_s for run in plan.runs) + sum(transfers_s[data] for data in plan.data)
        assert plan.busy_s == pytest.approx(busy_s)
        assert [run.duration_s for run in plan.runs] == sorted((run.duration_s for run in plan.runs), reverse=True)


def test_data_stays_together_where_it_can() -> None:
    plans = place([group("a", 50, *[100] * 4), group("b", 50, *[100] * 4)], 2)
    assert sorted(plan.data for plan in plans) == [["a"], ["b"]]
    assert makespan_s(plans) == pytest.approx(450)


def test_a_node_without_runs_gets_no_data() -> None:
    plans = place([group("a", 5, 100)], 3)
    assert [len(plan.data) for plan in plans] == [1, 0, 0]


@pytest.mark.parametrize("groups", [[], [group("a", 3)], [group("a", 0, 0.0, 0.0)]])
def test_nothing_to_do_takes_no_time(groups: list[DataRuns]) -> None:
    assert makespan_s(place(groups, 4)) == lower_bound_s(groups, 4) == 0


def test_bound_and_plan_enclose_the_best_schedule() -> None:
    draw = random.Random(3)
    for _ in range(25):
        groups = [
            group(data, draw.uniform(0, 20), *(draw.uniform(1, 60) for _ in range(draw.randint(1, 3)))) for data in "ab"
        ]
        plans = place(groups, 2)
        check_complete(plans, groups)
        best = best_s(groups, 2)
        assert lower_bound_s(groups, 2) <= best * (1 + 1e-9)
        assert best <= makespan_s(plans) * (1 + 1e-9)


@pytest.mark.parametrize("nodes", [2, 16, 64])
def test_many_mixed_runs_end_close_to_the_bound(nodes: int) -> None:
    draw = random.Random(5)
    groups = []
    for data in range(20):
        recording_s = draw.uniform(30, 600)
        runs_s = [recording_s * draw.uniform(0.5, 1.5) for _ in range(75)]
        groups.append(group(str(data), 0.12 * recording_s, *runs_s))
    plans = place(groups, nodes)
    check_complete(plans, groups)
    assert makespan_s(plans) <= 1.05 * lower_bound_s(groups, nodes)
