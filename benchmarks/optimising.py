"""Runs until the best of many configurations is found, for ``slamhive experiment optimise`` and for others.

The tables of ``search_tables.py`` stand for the runs that nobody makes. Each method has the same 20 of them. Its number
of runs is the first from which, in 19 of them, its best configuration is within 5 % of the truth, there and at each
later look. Methods: the model of SLAM Hive, Optuna's TPE and NSGA-II in its place, Optuna's TPE as it comes, random
search, and the whole grid in repeats.

With ``--front``, error and CPU use are searched for the best trade-offs. A front is near enough when no configuration
is better than all of it by more than 5 % in both.

    pip install optuna
    python benchmarks/optimising.py [--tables held-out] [--first 100] [--count 20] [--runs 300] [--most 1500] [--front]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.search_tables import Numbers, SearchTable, held_out_table, real_table, tuning_table
from slamhive.analysis.adaptive_search import SearchAim, SearchRuns, first_places, front_of, promoted, search
from slamhive.analysis.optuna_sampling import suggested
from slamhive.domain.question import SearchSampler
from slamhive.experiments.experiment import LEAST_SEARCH_RUNS

WITHIN, CONFIDENCE, LOOK_EVERY = 0.05, 0.95, 4
GRID_SHARE, OPTUNA_SHARE = 0.2, 0.7
MOST_REPEATS = 40
COSTS = (10, 20, 30, 40, 60, 80, 100, 150)
KEEP, CLIP_SHARE = 0.33, 15 / 120
"""First looks: the best third of clips of 15 s is run in full, over 120 s."""
TABLES: dict[str, Callable[[int], SearchTable]] = {
    "tuning": tuning_table,
    "held-out": held_out_table,
    "room": lambda _seed: real_table("room"),
    "kitti_06": lambda _seed: real_table("kitti_06"),
}


@dataclass(frozen=True, slots=True)
class Look:
    """After so many runs: how far the best is behind the truth, and how far it is said to be at most."""

    runs: float
    behind: float
    said: float | None = None


def behind_front(table: SearchTable, front: Sequence[int], objectives: int) -> float:
    """By which share a configuration is better than all of the front in all objectives."""
    scores = table.scores[:, :objectives]
    lacking = (scores[list(front)][:, None] - scores[None]).max(axis=2).min(axis=0).max()
    return float(np.expm1(max(0.0, lacking)))


def by_search(sampler: SearchSampler, table: SearchTable, seed: int, most: int, objectives: int) -> Iterator[Look]:
    """The search of SLAM Hive, with its own next runs or with Optuna's; its model gives the answer."""
    rng = np.random.default_rng(1000 + seed)
    worst = table.worst[:objectives]
    places = [int(place) for place in first_places(len(table.grid), seed)[:LEAST_SEARCH_RUNS]]
    scores = [table.draw(place, rng)[:objectives] for place in places]
    while len(scores) < most:
        found = np.array(scores)
        state = search(table.space, SearchRuns(np.array(places), found, worst), SearchAim(CONFIDENCE, LOOK_EVERY))
        yield Look(len(scores), behind_front(table, state.front, objectives), float(np.expm1(state.gap)))
        chosen = state.next
        if sampler is not SearchSampler.MODEL:
            finite = np.where(np.isfinite(found), found, worst)
            nothing = np.array([], dtype=np.intp)
            chosen = suggested(sampler, table.space, np.array(places), finite, LOOK_EVERY, nothing)
        places += chosen
        scores += [table.draw(place, rng)[:objectives] for place in chosen]


def by_first_looks(rho: float, table: SearchTable, seed: int, most: int, objectives: int) -> Iterator[Look]:
    """The search with first looks at clips; runs are counted in lengths of the whole recording."""
    rng = np.random.default_rng(1000 + seed)
    clips = table.with_clips(rho, seed)
    worst = table.worst[:objectives]
    looks: dict[int, float] = {}
    places: list[int] = []
    scores: list[Numbers] = []
    chosen = [int(place) for place in first_places(len(table.grid), seed)[: math.ceil(LEAST_SEARCH_RUNS / KEEP)]]
    new, followed = chosen, []
    while len(scores) + CLIP_SHARE * len(looks) < most:
        looks |= {place: clips.draw_clip(place, rng) for place in new}
        if not places:
            followed = promoted(looks, KEEP)[:LEAST_SEARCH_RUNS]
        places += followed
        scores += [table.draw(place, rng)[:objectives] for place in followed]
        found = SearchRuns(np.array(places), np.array(scores), worst)
        state = search(table.space, found, SearchAim(CONFIDENCE, LOOK_EVERY))
        cost = len(scores) + CLIP_SHARE * len(looks)
        yield Look(cost, behind_front(table, state.front, objectives), float(np.expm1(state.gap)))
        new = [place for place in dict.fromkeys(state.next) if place not in places and place not in looks]
        followed = [place for place in promoted(looks, KEEP) if place not in places]
        behind = [place for place in state.next if place not in places and place in looks and place not in followed]
        followed += sorted(behind, key=lambda place: looks[place])[:1]
        followed = [*followed, *(place for place in state.next if place in places)][:LOOK_EVERY]


def by_optuna(sampler: SearchSampler, table: SearchTable, seed: int, most: int, objectives: int) -> Iterator[Look]:
    """Optuna as it comes: a failed run is a failed trial, and the best trials are the answer."""
    import optuna  # noqa: PLC0415

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    rng = np.random.default_rng(1000 + seed)
    places = {tuple(row): place for place, row in enumerate(table.grid.tolist())}
    kinds = optuna.samplers
    chosen = kinds.TPESampler(seed=seed) if sampler is SearchSampler.TPE else kinds.NSGAIISampler(seed=seed)
    study = optuna.create_study(directions=["minimize"] * objectives, sampler=chosen)
    good: list[Numbers] = []
    at: list[int] = []
    for runs in range(1, most + 1):
        trial = study.ask()
        levels = []
        for axis, (ordered, last) in enumerate(zip(table.ordered, table.grid.max(axis=0).tolist(), strict=True)):
            name = f"axis {axis}"
            level = trial.suggest_int(name, 0, last) if ordered else trial.suggest_categorical(name, range(last + 1))
            levels.append(int(level))
        place = places[tuple(levels)]
        values = table.draw(place, rng)[:objectives]
        if np.isfinite(values).all():
            study.tell(trial, values.tolist())
            good.append(values)
            at.append(place)
        else:
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
        if runs % LOOK_EVERY == 0 and good:
            front = [at[trial] for trial in front_of(np.array(good))]
            yield Look(runs, behind_front(table, front, objectives))


def by_chance(table: SearchTable, seed: int, most: int, objectives: int) -> Iterator[Look]:
    """Random configurations, no one twice until all have run; the best means are the answer."""
    rng = np.random.default_rng(1000 + seed)
    worst = table.worst[:objectives]
    sums, counts = np.zeros((len(table.grid), objectives)), np.zeros(len(table.grid))
    for runs in range(1, most + 1):
        if (runs - 1) % len(table.grid) == 0:
            order = rng.permutation(len(table.grid))
        place = order[(runs - 1) % len(table.grid)]
        values = table.draw(place, rng)[:objectives]
        sums[place] += np.where(np.isfinite(values), values, worst)
        counts[place] += 1
        if runs % LOOK_EVERY == 0:
            tried = np.flatnonzero(counts)
            front = tried[front_of(sums[tried] / counts[tried, None])]
            yield Look(runs, behind_front(table, front.tolist(), objectives))


def by_grid(table: SearchTable, seed: int, most: int, objectives: int) -> Iterator[Look]:
    """The whole grid, once, twice and so on."""
    rng = np.random.default_rng(1000 + seed)
    size = len(table.grid)
    sums = np.zeros((size, objectives))
    for repeat in range(1, most // size + 1):
        drawn = np.array([table.draw(place, rng)[:objectives] for place in range(size)])
        sums += np.where(np.isfinite(drawn), drawn, table.worst[:objectives])
        yield Look(repeat * size, behind_front(table, front_of(sums / repeat).tolist(), objectives))


METHODS: dict[str, Callable[[SearchTable, int, int, int], Iterator[Look]]] = {
    "model": partial(by_search, SearchSampler.MODEL),
    "tpe": partial(by_search, SearchSampler.TPE),
    "nsga2": partial(by_search, SearchSampler.NSGA2),
    "looks 0.7": partial(by_first_looks, 0.7),
    "looks 0.4": partial(by_first_looks, 0.4),
    "plain tpe": partial(by_optuna, SearchSampler.TPE),
    "plain nsga2": partial(by_optuna, SearchSampler.NSGA2),
    "random": by_chance,
    "grid": by_grid,
}


def runs_needed(looks: Sequence[Sequence[Look]]) -> float | None:
    """The first number of runs from which on enough tables are answered rightly; None if there is none."""
    needed = 0.0
    for row in zip(*looks, strict=False):
        right = sum(look.behind <= WITHIN for look in row)
        if right < CONFIDENCE * len(row):
            needed = 0.0
        elif not needed:
            needed = max(look.runs for look in row)
    return needed or None


def right_after(looks: Sequence[Sequence[Look]], cost: float) -> int:
    """The number of tables on which the last look up to a cost was right."""
    known = ([look for look in of_table if look.runs <= cost] for of_table in looks)
    return sum(bool(of_table) and of_table[-1].behind <= WITHIN for of_table in known)


def measured(method: str, kind: str, most: int, objectives: int, seed: int) -> list[Look]:
    """The looks of a method at one table."""
    return list(METHODS[method](TABLES[kind](seed), seed, most, objectives))


def summary(looks: Sequence[Sequence[Look]]) -> dict[str, Any]:
    """Sum up a method: runs needed, tables right at the end, and what it says of itself."""
    found: dict[str, Any] = {
        "runs": runs_needed(looks),
        "looked until": min(of_table[-1].runs for of_table in looks),
        "right after": {cost: right_after(looks, cost) for cost in COSTS},
        "right at the end": sum(of_table[-1].behind <= WITHIN for of_table in looks),
        "behind at the end, median": float(np.median([of_table[-1].behind for of_table in looks])),
        "behind at the end, largest": max(of_table[-1].behind for of_table in looks),
    }
    told = [look for of_table in looks for look in of_table if look.said is not None]
    if told:
        found["gap too small"] = sum(look.behind > (look.said or 0.0) for look in told) / len(told)
        stops = [next((look for look in of if look.said is not None and look.said <= WITHIN), None) for of in looks]
        stopped = [look for look in stops if look is not None]
        found["stopped"] = len(stopped)
        found["stopped right"] = sum(look.behind <= WITHIN for look in stopped)
        found["stopped after, median"] = float(np.median([look.runs for look in stopped])) if stopped else None
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", choices=TABLES, default="held-out")
    parser.add_argument("--first", type=int, default=100, help="first seed")
    parser.add_argument("--count", type=int, default=20, help="number of tables")
    parser.add_argument("--runs", type=int, default=300, help="most runs of a search with the model")
    parser.add_argument("--most", type=int, default=1500, help="most runs of plain Optuna and of random search")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--front", action="store_true", help="error and CPU use")
    parser.add_argument("--processes", type=int, default=1)
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.count)
    size = len(TABLES[options.tables](options.first).grid)
    limits = {"grid": MOST_REPEATS * size, "plain tpe": options.most, "plain nsga2": options.most}
    limits["random"] = options.most
    found: dict[str, Any] = {"tables": options.tables, "configurations": size, "count": options.count}
    with Pool(options.processes) as pool:
        for method in options.methods.split(","):
            most = limits.get(method, options.runs)
            of_table = partial(measured, method, options.tables, most, 2 if options.front else 1)
            found[method] = summary(pool.map(of_table, seeds, chunksize=1))
            print(json.dumps({method: found[method]}), file=sys.stderr, flush=True)
    needed, plain = found.get("model", {}).get("runs"), found.get("plain tpe", {}).get("runs")
    found["at most a fifth of the grid"] = needed is not None and needed <= GRID_SHARE * size
    found["at most 0.7 of plain Optuna"] = needed is not None and needed <= OPTUNA_SHARE * (plain or math.inf)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
