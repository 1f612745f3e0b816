"""Duration of experiments on a cluster, by how runs are given to nodes: ratios to a bound that nobody can beat.

    python benchmarks/placement.py [--runs 1500 100000] [--nodes 2 4 8 16 32 64 128 256] [--draws 20] [--json]

Runs are made up: recordings of 30 to 600 s, each run in real time or at a speed of its own. A second of a recording
takes 0.12 s of transfer (13 MB/s of images over 1 Gbit/s). Stragglers are 1 % of the runs. They take 1.5 to 3 times
as long as expected, which no schedule knows before. Which runs they are is drawn several times; all columns are means.

There are two bounds. Not even foresight beats ``bound h``, to which the methods are compared. With stragglers
it knows them before, so that with few runs for each node nobody can come near it. ``unforeseen`` is the ratio to it
of a second bound, which holds for the mean of every scheduler without foresight: :mod:`benchmarks.straggler_bound`
proves it. Fails if our placement takes more than 1.05 times the first bound; with stragglers only if nodes have at
least 20 runs each. ``to reach`` is ours by the second bound.

The columns:

- published: the assignment of the published SLAM Hive, which takes classes of algorithm and dataset in turn.
- greedy: a free node takes the next run of the file.
- longest first: a free node takes the longest run that waits.
- ours: slamhive.domain.placement for all but the shortest runs, which free nodes take at the end.
- unforeseen, to reach: see above.
"""

from __future__ import annotations

import argparse
import heapq
import json
import random
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.straggler_bound import Law, expected_end_at_least_s
from slamhive.domain.placement import DataRuns, lower_bound_s, place

BOUND_RATIO = 1.05
STRAGGLER_FRACTION = 0.01
STRAGGLER_FACTORS = (1.5, 3.0)
TRANSFER_PER_RECORDING = 0.12
RESERVE_FRACTION = 0.15
"""The shortest runs, which together take this part of the time, are not planned: they fill what stragglers leave."""
LARGEST_RESERVE_FRACTION = 0.4
RESERVE_PER_NODE = 5
"""Where stragglers are expected, the reserve is about so many of a node's runs, up to the largest fraction."""
RUNS_PER_NODE = 20
"""With fewer, one straggler near the end decides, which only the bound knows before."""
FIRST_SEED = 1000
"""Of the draws. The fractions above were chosen with others."""
ALGORITHMS, RECORDINGS = 10, 20


@dataclass(frozen=True, slots=True)
class Run:
    """One run. ``expected_s`` is known before, ``actual_s`` is not."""

    algorithm: int
    data: str
    transfer_s: float
    expected_s: float
    actual_s: float


def make_runs(count: int, seed: int = 7) -> list[Run]:
    """Mixed runs in the order of an experiment file: algorithm, recording, repeats. None is a straggler."""
    draw = random.Random(seed)
    recordings_s = [draw.uniform(30, 600) for _ in range(RECORDINGS)]
    speeds = [1.0 if draw.random() < 0.6 else draw.uniform(0.3, 2.0) for _ in range(ALGORITHMS)]
    chosen = sorted((draw.randrange(ALGORITHMS), draw.randrange(RECORDINGS)) for _ in range(count))
    runs = []
    for algorithm, recording in chosen:
        expected_s = recordings_s[recording] * speeds[algorithm] * draw.uniform(0.97, 1.03) + 10.0
        transfer_s = TRANSFER_PER_RECORDING * recordings_s[recording]
        runs.append(Run(algorithm, f"recording {recording:02}", transfer_s, expected_s, expected_s))
    return runs


def with_stragglers(runs: Sequence[Run], seed: int) -> list[Run]:
    """The same runs; some take longer than expected."""
    draw = random.Random(seed)

    def factor() -> float:
        return draw.uniform(*STRAGGLER_FACTORS) if draw.random() < STRAGGLER_FRACTION else 1.0

    return [replace(run, actual_s=run.expected_s * factor()) for run in runs]


def groups_of(runs: Sequence[Run], seconds: Callable[[Run], float]) -> list[DataRuns]:
    """The runs by their data."""
    by_data: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        by_data[run.data].append(run)
    return [DataRuns(data, same[0].transfer_s, tuple(map(seconds, same))) for data, same in by_data.items()]


def published(runs: Sequence[Run], nodes: int) -> float:
    """Round-robin over the classes: an empty node, else one that has the class and less than its share, else any."""
    classes: dict[tuple[int, str], list[Run]] = defaultdict(list)
    for run in runs:
        classes[run.algorithm, run.data].append(run)
    share = len(runs) // nodes + 1
    lists: list[list[Run]] = [[] for _ in range(nodes)]
    holders: dict[tuple[int, str], list[int]] = defaultdict(list)
    empty = 0
    for turn in range(max(map(len, classes.values()))):
        for key, same in classes.items():
            if turn >= len(same):
                continue
            known = holders[key]
            if empty < nodes:
                node, empty = empty, empty + 1
            else:
                node = next((one for one in known if len(lists[one]) < share), -1)
                if node < 0:
                    node = next(one for one in range(nodes) if len(lists[one]) < share)
            if node not in known:
                known.append(node)
            lists[node].append(same[turn])
    return max(_in_turn(one) for one in lists)


def _in_turn(runs: Sequence[Run]) -> float:
    transfers_s = {run.data: run.transfer_s for run in runs}
    return sum(run.actual_s for run in runs) + sum(transfers_s.values())


def one_queue(runs: Sequence[Run], nodes: int) -> float:
    """Each node takes the next run when it has finished one."""
    free = [(0.0, node) for node in range(nodes)]
    held: list[set[str]] = [set() for _ in range(nodes)]
    last_s = 0.0
    for run in runs:
        now_s, node = heapq.heappop(free)
        end_s = now_s + run.actual_s + (0.0 if run.data in held[node] else run.transfer_s)
        held[node].add(run.data)
        last_s = max(last_s, end_s)
        heapq.heappush(free, (end_s, node))
    return last_s


def longest_first(runs: Sequence[Run], nodes: int) -> float:
    """The same, the longest run first."""
    return one_queue(sorted(runs, key=lambda run: -run.expected_s), nodes)


@dataclass(slots=True)
class _Node:
    waiting: list[Run]
    """The next one last."""
    held: set[str]
    left_s: float
    """Expected, of what waits."""
    expected_end_s: float = 0.0
    """Of the run that it executes."""

    def cost_s(self, run: Run) -> float:
        return run.expected_s + (0.0 if run.data in self.held else run.transfer_s)


class _Reserve:
    """Short runs that no node has in its plan; those who finish early take them."""

    def __init__(self, runs: Sequence[Run]) -> None:
        self._by_data: dict[str, list[Run]] = defaultdict(list)
        for run in sorted(runs, key=lambda run: run.expected_s):
            self._by_data[run.data].append(run)

    def take(self, node: _Node) -> Run | None:
        """The longest run on data that the node has, else the longest of all; None if there is none."""
        longest = [runs[-1] for runs in self._by_data.values() if runs]
        run = max(longest, key=lambda run: (run.data in node.held, run.expected_s), default=None)
        return None if run is None else self._by_data[run.data].pop()


def split(runs: Sequence[Run], fraction: float) -> tuple[list[Run], list[Run]]:
    """The runs that are planned, and the shortest ones that together take ``fraction`` of the time."""
    ordered = sorted(runs, key=lambda run: run.expected_s)
    most_s, count = fraction * sum(run.expected_s for run in runs), 0
    while most_s > 0:
        most_s -= ordered[count].expected_s
        count += 1
    return ordered[count:], ordered[:count]


def ours(runs: Sequence[Run], nodes: int, *, expects_stragglers: bool = False) -> float:
    """The plan for the longer runs; the shorter ones fill what stragglers leave."""
    few = min(LARGEST_RESERVE_FRACTION, RESERVE_PER_NODE * nodes / len(runs)) if expects_stragglers else 0.0
    planned, short = split(runs, max(RESERVE_FRACTION, few))
    reserve = _Reserve(short)
    by_data: dict[str, list[Run]] = defaultdict(list)
    for entry in planned:
        by_data[entry.data].append(entry)
    cluster = []
    for plan in place(groups_of(planned, lambda run: run.expected_s), nodes):
        waiting = [by_data[placed.data][placed.index] for placed in reversed(plan.runs)]
        cluster.append(_Node(waiting, set(), plan.busy_s))
    free = [(0.0, number) for number in range(nodes)]
    last_s = 0.0
    while free:
        now_s, number = heapq.heappop(free)
        node = cluster[number]
        chosen = _next(cluster, node, reserve, now_s)
        if chosen is None:
            continue
        end_s = now_s + chosen.actual_s + (0.0 if chosen.data in node.held else chosen.transfer_s)
        node.expected_end_s = now_s + node.cost_s(chosen)
        node.held.add(chosen.data)
        last_s = max(last_s, end_s)
        heapq.heappush(free, (end_s, number))
    return last_s


def _next(cluster: Sequence[_Node], node: _Node, reserve: _Reserve, now_s: float) -> Run | None:
    """The next run of the plan, else of the reserve, else one that another node would finish later."""
    if node.waiting:
        run = node.waiting.pop()
        node.left_s -= node.cost_s(run)
        return run
    return reserve.take(node) or _taken_over(cluster, node, now_s)


def _taken_over(cluster: Sequence[_Node], node: _Node, now_s: float) -> Run | None:
    with_most = max((one for one in cluster if one.waiting), key=lambda one: _end_s(one, now_s), default=None)
    if with_most is None or now_s + node.cost_s(with_most.waiting[0]) >= _end_s(with_most, now_s):
        return None
    run = with_most.waiting.pop(0)
    with_most.left_s -= with_most.cost_s(run)
    return run


def _end_s(node: _Node, now_s: float) -> float:
    """Time at which a node is expected to finish its waiting runs."""
    return max(node.expected_end_s, now_s) + node.left_s


METHODS = {"published": published, "greedy": one_queue, "longest first": longest_first, "ours": ours}


def measure(count: int, nodes: int, draws: int) -> dict[str, object]:
    """One row of the table; without ``draws`` nobody is a straggler."""
    planned = make_runs(count)
    drawn = [with_stragglers(planned, seed) for seed in range(FIRST_SEED, FIRST_SEED + draws)] or [planned]
    bounds_s = [lower_bound_s(groups_of(runs, lambda run: run.actual_s), nodes) for runs in drawn]
    bound_s = fmean(bounds_s)
    methods: dict[str, Callable[[Sequence[Run], int], float]] = {
        **METHODS,
        "ours": partial(ours, expects_stragglers=draws > 0),
    }
    ends_s = {name: fmean(method(runs, nodes) for runs in drawn) for name, method in methods.items()}
    if draws:
        earliest_s = lower_bound_s(groups_of(planned, lambda run: run.expected_s), nodes)
        law = Law(STRAGGLER_FRACTION, *STRAGGLER_FACTORS)
        durations_s = [run.expected_s for run in planned]
        few = count < RUNS_PER_NODE * nodes
        unforeseen_s = expected_end_at_least_s(durations_s, nodes, earliest_s, law, bounds_s) if few else bound_s
        ends_s["unforeseen"] = max(bound_s, unforeseen_s)
    ratios = {name: round(end_s / bound_s, 3) for name, end_s in ends_s.items()}
    reach = {"to reach": round(ends_s["ours"] / ends_s["unforeseen"], 3)} if draws else {}
    return {"runs": count, "nodes": nodes, "draws": draws, "bound_h": round(bound_s / 3600, 3), **ratios, **reach}


def _draws(asked: int, count: int) -> int:
    """So many draws that a row takes about as long as one of 1,500 runs; many runs hardly differ between draws."""
    return max(1, min(asked, asked * 1500 // count))


def main() -> int:
    """Simulate, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, nargs="+", default=[1_500, 100_000])
    parser.add_argument("--nodes", type=int, nargs="+", default=[2, 4, 8, 16, 32, 64, 128, 256])
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = [
        measure(count, nodes, draws)
        for count in options.runs
        for draws in (0, _draws(options.draws, count))
        for nodes in options.nodes
    ]
    if options.json:
        print(json.dumps({"bound_ratio": BOUND_RATIO, "rows": rows}, indent=1))
    else:
        _print(rows)
    asked = [row for row in rows if _counts(row)]
    return 0 if all(float(str(row["ours"])) <= BOUND_RATIO for row in asked) else 1


def _print(rows: Sequence[Mapping[str, object]]) -> None:
    names = (*METHODS, "unforeseen", "to reach")
    print("     runs nodes stragglers   bound h " + " ".join(f"{name:>13}" for name in names))
    for row in rows:
        ratios = " ".join(f"{row.get(name, ''):>13}" for name in names)
        late = f"{row['draws']} draws" if row["draws"] else "no"
        print(f"{row['runs']:>9,} {row['nodes']:>5} {late:>10} {row['bound_h']:>9} {ratios}")


def _counts(row: Mapping[str, object]) -> bool:
    return not row["draws"] or int(str(row["runs"])) >= RUNS_PER_NODE * int(str(row["nodes"]))


if __name__ == "__main__":
    sys.exit(main())
