"""Placement of runs on nodes: long runs first, few copies of the data, all nodes busy until the end.

The engine of a cluster decides where a run goes. What is computed here says how long an experiment takes and how
much data moves, and in which order runs should start.
"""

from __future__ import annotations

import hashlib
import json
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from math import ceil

from slamhive.domain.configuration import Variant

_ENOUGH = 1e-3
"""The search for the shortest schedule ends when it can gain no more than this fraction."""


@dataclass(frozen=True, slots=True)
class DataRuns:
    """Runs on the same data, which a node has to get once.

    Attributes:
        data: Names the data.
        transfer_s: How long a node takes to get it.
        durations_s: Of each run, in any order.
    """

    data: str
    transfer_s: float
    durations_s: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PlacedRun:
    """Run ``index`` of the runs on ``data``."""

    data: str
    index: int
    duration_s: float


@dataclass(slots=True)
class NodePlan:
    """Share of one node: data, and runs in the order of their start."""

    data: list[str] = field(default_factory=list)
    runs: list[PlacedRun] = field(default_factory=list)
    busy_s: float = 0.0


def place(groups: Sequence[DataRuns], nodes: int) -> list[NodePlan]:
    """A schedule that ends early; at most a few percent later than :func:`lower_bound_s` for many runs.

    For a given end, each group fills the emptiest nodes, the group with the longest run first. The earliest end for
    which everything fits is found by bisection.

    Args:
        groups: The runs, each data in one group.
        nodes: How many nodes there are, at least 1.
    """
    # The group with the longest run comes first: what is placed last has to fill the gaps.
    sorted_runs = [
        (group, sorted((duration_s, index) for index, duration_s in enumerate(group.durations_s)))
        for group in groups
        if group.durations_s
    ]
    sorted_groups = sorted(sorted_runs, key=lambda entry: (-entry[1][-1][0], entry[0].data))
    too_early_s = lower_bound_s(groups, nodes)
    end_s = max(too_early_s, _ENOUGH)
    best = _fill(sorted_groups, nodes, end_s)
    while best is None:
        too_early_s, end_s = end_s, 1.25 * end_s
        best = _fill(sorted_groups, nodes, end_s)
    while end_s - too_early_s > _ENOUGH * end_s:
        middle_s = (too_early_s + end_s) / 2
        found = _fill(sorted_groups, nodes, middle_s)
        if found is None:
            too_early_s = middle_s
        else:
            best, end_s = found, middle_s
    for node in best:
        node.runs.sort(key=lambda run: -run.duration_s)
    return best


def makespan_s(plans: Sequence[NodePlan]) -> float:
    """Time at which the last node has finished."""
    return max((plan.busy_s for plan in plans), default=0.0)


def lower_bound_s(groups: Sequence[DataRuns], nodes: int) -> float:
    """No schedule ends earlier, whatever it knows.

    It is the largest of three bounds. One is the longest run with its transfer. One is the node that must take the most
    of the longest runs. One is the total work, in which each data counts for as many nodes as its runs need.
    """
    groups = [group for group in groups if group.durations_s]
    longest_s = max((max(group.durations_s) + group.transfer_s for group in groups), default=0.0)
    durations_s = sorted((one for group in groups for one in group.durations_s), reverse=True)
    sums_s = [0.0, *accumulate(durations_s)]
    rows = enumerate(range(0, len(durations_s), nodes))
    crowded_s = max((sums_s[last + 1] - sums_s[last - row] for row, last in rows), default=0.0)
    low_s = max(longest_s, crowded_s, sum(durations_s) / nodes)
    if _fits_in_total(groups, nodes, low_s):
        return low_s
    high_s = low_s + sum(group.transfer_s for group in groups)
    while high_s - low_s > 1e-6 * high_s:
        middle_s = (low_s + high_s) / 2
        low_s, high_s = (low_s, middle_s) if _fits_in_total(groups, nodes, middle_s) else (middle_s, high_s)
    return low_s


def _fits_in_total(groups: Sequence[DataRuns], nodes: int, end_s: float) -> bool:
    """Tell if work and transfers fit into the time of all nodes, if each node could be filled to the end."""
    needed_s = 0.0
    for group in groups:
        work_s = sum(group.durations_s)
        if work_s:
            needed_s += work_s + ceil(work_s / (end_s - group.transfer_s) - 1e-9) * group.transfer_s
    return needed_s <= nodes * end_s * (1 + 1e-12)


_Sorted = list[tuple[DataRuns, list[tuple[float, int]]]]
"""Each group with its runs as (duration, index), the shortest first."""


def _fill(groups: _Sorted, nodes: int, end_s: float) -> list[NodePlan] | None:
    """Put all runs on nodes so that none works longer than ``end_s``; None if they do not fit this way."""
    plans = [NodePlan() for _ in range(nodes)]
    for group, runs in groups:
        waiting = list(runs)
        for plan in sorted(plans, key=lambda plan: plan.busy_s):
            # Each time the longest run that fits.
            room_s = end_s - plan.busy_s - group.transfer_s
            taken = len(plan.runs)
            while (fitting := bisect_right(waiting, (room_s, len(group.durations_s)))) > 0:
                duration_s, index = waiting.pop(fitting - 1)
                plan.runs.append(PlacedRun(group.data, index, duration_s))
                room_s -= duration_s
            if len(plan.runs) > taken:
                plan.data.append(group.data)
                plan.busy_s = end_s - room_s
            if not waiting:
                break
        if waiting:
            return None
    return plans


# Which runs should follow each other: those with the same variant of a dataset, and among them the same image.


_DATA_DIGITS = 16
_PACKAGE_DIGITS = 8
_BETWEEN = "-"
_AFTER = chr(ord(_BETWEEN) + 1)


def run_affinity(dataset: str, variant: Variant, package: str) -> str:
    """25 characters that are equal for runs of one package on the same data.

    The first part depends on dataset and variant only, so that runs of other packages on the same data sort next to it.
    """
    steps = [{"kind": step.kind, "sensors": step.sensors, "options": step.options} for step in variant]
    data = _digest([dataset, steps])[:_DATA_DIGITS]
    return f"{data}{_BETWEEN}{_digest(package)[:_PACKAGE_DIGITS]}"


def same_data(affinity: str) -> tuple[str, str]:
    """Bounds of the affinities of all runs on the same data: at least the first, below the second."""
    data = affinity[:_DATA_DIGITS]
    return data + _BETWEEN, data + _AFTER


def _digest(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


# How long something will still take: the expected time, and the interval that it lies in nine times of ten.


@dataclass(frozen=True, slots=True)
class Remaining:
    """Seconds. ``low_s`` and ``high_s`` are None while nothing like it was measured."""

    seconds: float
    low_s: float | None = None
    high_s: float | None = None

    def __add__(self, other: Remaining) -> Remaining:
        """One after the other. A part without an interval counts with its expected time."""
        if self.low_s is None and other.low_s is None:
            return Remaining(self.seconds + other.seconds)
        lows, highs = zip(self._ends(), other._ends(), strict=True)
        return Remaining(self.seconds + other.seconds, sum(lows), sum(highs))

    def words(self, including: str = "") -> str:
        """``9 to 16 min left``, or ``about 13 min left, not measured yet``; ``including`` comes after ``left``."""
        return f"{self.span} left{including}{', not measured yet' if self.low_s is None else ''}"

    @property
    def span(self) -> str:
        """``9 to 16 min``; ``about 13 min`` without an interval, or if both ends are alike."""
        low, high = map(rounded, self._ends())
        if low == high:
            return f"about {high}"
        number, _, unit = low.partition(" ")
        return f"{number if high.endswith(f' {unit}') else low} to {high}"

    def _ends(self) -> tuple[float, float]:
        if self.low_s is None or self.high_s is None:
            return self.seconds, self.seconds
        return self.low_s, self.high_s


def rounded(seconds: float) -> str:
    """A time no more exact than it is known: ``45 s``, ``2.5 min``, ``13 min``, ``1.6 h``, ``3.2 d``."""
    if seconds < 57.5:
        return f"{max(5, round(seconds / 5) * 5)} s"
    if seconds < 5400:
        return _number(seconds / 60, 3, "min")
    if seconds < 172_800:
        return _number(seconds / 3600, 10, "h")
    return _number(seconds / 86_400, 10, "d")


def _number(amount: float, exact_below: float, unit: str) -> str:
    """One decimal for small numbers, none for others."""
    return f"{amount:.1f} {unit}" if amount < exact_below else f"{amount:.0f} {unit}"
