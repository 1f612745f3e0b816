"""Bound on how early runs can end on average if nobody knows the stragglers before, for all such schedulers.

A run takes its expected time, times a factor. Factors are independent of each other. A scheduler may know how they are
distributed and may use luck. It learns the factor of a run only while the run goes on, and does not interrupt runs.

**The chance to end by T.** Let q(x) be the chance that a factor is above x, and let S be the start of a run with the
expected time p. The run is over by T if its factor is at most (T - S) / p. Look at the runs in the order of their
starts, and assume that the factors of all earlier ones are known: more than the scheduler knows. S follows from these
factors, and the factor of the run is independent of them. So the run is late with the chance q((T - S) / p). Let M be
the product, over all runs, of [not late] / (1 - q((T - S) / p)). Each factor of the product has the mean 1, given the
earlier ones, so M has the mean 1. Where no run is late, M = exp(R) with R = sum of -log(1 - q((T - S) / p)). Hence

    chance to end by T = E[none is late] = E[M exp(-R), none is late] <= exp(-least R),

where the least R is taken over all schedules that end by T. In these, each run takes at least its expected time. So the
least R over schedules of the expected times, which may leave gaps, is not larger.

**The least R.** A schedule gives each node a sequence of runs. Let each run have a price. Then R is at least the prices
of all runs, plus, for each node, the least that a sequence can have of (its R - its prices). This is true of all prices
(weak duality). Dynamic programming finds the cheapest sequence, from the end to the start. It rounds in one
direction: runs count as the shortest of their class, and starts as earlier. Linear programming finds good prices.
Whatever it finds, the bound holds.

**The mean.** The mean end is the integral of the chance to end after T. That chance is at least 1 - exp(-least R), and
1 below the bound for the expected times. It falls with T, so the value at the end of a step holds for all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, exp

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

Floats = NDArray[np.float64]

CLASS_WIDTH = 1.02
"""The longest run of a class by the shortest one."""
GRID = 600
"""Steps of time up to the end."""
STEP = 1.02
"""From one end that is looked at to the next one."""
ENOUGH = 0.97
"""Prices are good enough if the bound is this part of what the linear program promises."""
MOST_ROUNDS = 600
NEGLIGIBLE = 0.02


@dataclass(frozen=True, slots=True)
class Law:
    """A run is a straggler with the chance ``fraction``; its factor is then uniform from ``least`` to ``most``."""

    fraction: float
    least: float
    most: float

    def risk(self, x: Floats) -> Floats:
        """-log(1 - q(x)); what is below 1 counts as 1."""
        above = np.clip((self.most - x) / (self.most - self.least), 0.0, 1.0)
        return np.asarray(-np.log1p(-self.fraction * above))


@dataclass(frozen=True, slots=True)
class _Classes:
    """Runs of almost the same length: the shortest of each class (s), and how many there are."""

    shortest_s: Floats
    counts: Floats


def expected_end_at_least_s(
    durations_s: Sequence[float], nodes: int, earliest_s: float, law: Law, foreseen_s: Sequence[float] = ()
) -> float:
    """The mean end of any scheduler without foresight is not smaller (s).

    Args:
        durations_s: The expected time of each run.
        nodes: How many there are.
        earliest_s: No schedule of the expected times ends earlier.
        law: Of the factors.
        foreseen_s: Ends that not even foresight beats, of draws of the factors: they estimate how likely such ends are.
    """
    total_s, at_s, certain = earliest_s, earliest_s, 1.0
    while certain > NEGLIGIBLE:
        next_s = STEP * at_s
        unforeseen = 1.0 - exp(-least_risk(durations_s, nodes, next_s, law))
        foreseen = sum(end_s > next_s for end_s in foreseen_s) / max(1, len(foreseen_s))
        certain = max(unforeseen, foreseen)
        total_s += (next_s - at_s) * certain
        at_s = next_s
    return total_s


def least_risk(durations_s: Sequence[float], nodes: int, end_s: float, law: Law) -> float:
    """No schedule on so many nodes that ends by ``end_s`` has a smaller R."""
    classes = _classes(durations_s)
    pricing = _Pricing(classes, end_s, law)
    columns: list[Floats] = []
    risks: list[float] = []
    best = 0.0
    for _ in range(MOST_ROUNDS):
        promised, prices = _prices(classes, nodes, columns, risks, pricing.penalty)
        cheapest, counts, risk = pricing.cheapest(prices)
        best = max(best, float(classes.counts @ prices) + nodes * min(0.0, cheapest))
        if best >= ENOUGH * promised:
            break
        columns.append(counts)
        risks.append(risk)
    return best


def _classes(durations_s: Sequence[float]) -> _Classes:
    shortest: list[float] = []
    counts: list[int] = []
    for duration_s in sorted(durations_s):
        if not shortest or duration_s > CLASS_WIDTH * shortest[-1]:
            shortest.append(duration_s)
            counts.append(0)
        counts[-1] += 1
    return _Classes(np.array(shortest), np.array(counts, dtype=np.float64))


class _Pricing:
    """Finds the cheapest sequence of a node for given prices. Places are counted from the end, in steps of time."""

    def __init__(self, classes: _Classes, end_s: float, law: Law) -> None:
        self._steps = max(GRID, ceil(end_s / float(classes.shortest_s[0])) + 1)
        step_s = end_s / self._steps
        self._widths = np.floor(classes.shortest_s / step_s).astype(np.int64)
        starts_s = step_s * np.arange(self._steps + 1)
        self._risks = law.risk(starts_s[:, None] / classes.shortest_s[None, :])
        self.penalty = 20.0 * float(law.risk(np.ones(1))[0])
        """What a run costs that has no place: prices stay finite where not all runs fit."""

    def cheapest(self, prices: Floats) -> tuple[float, Floats, float]:
        """The least of R less prices, how many runs of each class its sequence has, and its R."""
        costs = np.zeros(self._steps + 1)
        last = np.full(self._steps + 1, -1)
        reduced = self._risks - prices[None, :]
        for place in range(1, self._steps + 1):
            fits = self._widths <= place
            found = costs[place - self._widths[fits]] + reduced[place, fits]
            chosen = int(np.argmin(found)) if len(found) else -1
            costs[place] = costs[place - 1]
            if chosen >= 0 and found[chosen] < costs[place]:
                costs[place], last[place] = found[chosen], int(np.flatnonzero(fits)[chosen])
        return float(costs[-1]), *self._sequence(last)

    def _sequence(self, last: NDArray[np.int64]) -> tuple[Floats, float]:
        counts, risk, place = np.zeros(len(self._widths)), 0.0, self._steps
        while place > 0:
            run = int(last[place])
            if run < 0:
                place -= 1
                continue
            counts[run] += 1
            risk += float(self._risks[place, run])
            place -= int(self._widths[run])
        return counts, risk


def _prices(
    classes: _Classes, nodes: int, columns: Sequence[Floats], risks: Sequence[float], penalty: float
) -> tuple[float, Floats]:
    """The least R of mixtures of the sequences known so far, and the prices of runs that belong to it."""
    count = len(classes.counts)
    covered = np.hstack([np.array(columns).T.reshape(count, len(columns)), np.eye(count)])
    used = np.concatenate([np.ones(len(columns)), np.zeros(count)])
    found = linprog(
        np.concatenate([np.array(risks), np.full(count, penalty)]),
        A_ub=np.vstack([-covered, used]),
        b_ub=np.concatenate([-classes.counts, [float(nodes)]]),
        method="highs",
    )
    return float(found.fun), np.maximum(0.0, -found.ineqlin.marginals[:count])
