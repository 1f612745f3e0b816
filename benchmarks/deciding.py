"""False answers of ``slamhive experiment decide``, and the runs it saves against a fixed plan of equal power.

Each question is asked 1000 times of simulated runs: two algorithms without a difference, and with differences of one,
two and four times the smallest one that matters. Three kinds of noise: normal, log-normal as errors of SLAM systems
are, and log-normal with one run in ten failed. One and four datasets; and the best of ten.

**The fixed plan** makes n runs of each algorithm on each dataset and looks once, with Student's intervals and the same
rule of answers. Nobody knows the difference beforehand, so one n has to serve for all four. It is the smallest n that
answers rightly as often as the sequential plan does, whatever the difference is; the level of its intervals is chosen
in its favour. An informed plan, which knows the difference beforehand, is printed beside it.

    python benchmarks/deciding.py [--questions 1000] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slamhive.analysis.racing import RaceAnswer, RaceRule, counted, race
from slamhive.domain.gate import Margin

Numbers = NDArray[np.float64]

MEAN_M = 0.05
SPREAD_M = 0.01
"""Standard deviation of a good run."""
EFFECTS = (0.0, 1.0, 2.0, 4.0)
"""In differences that matter."""
ERROR = 0.05
LEVELS = (0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
"""Of the intervals of the fixed plan."""
MOST_ROUNDS = {1: 120, 4: 40}
LARGEST_ERROR, LEAST_SAVED = 0.05, 0.40


def main() -> None:
    """Simulate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--questions", type=int, default=1000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = [
        result
        for noise in NOISES
        for datasets in MOST_ROUNDS
        for result in simulate(noise, datasets, options.questions)
    ]
    ten = best_of_ten(options.questions)
    if options.json:
        print(json.dumps({"pairs": [asdict(entry) for entry in found], "ten": asdict(ten)}, indent=1))
        return
    print(f"{'noise':11} datasets effect  right  false   runs  fixed  saved  informed  saved")
    for entry in found:
        print(
            f"{entry.noise:11} {entry.datasets:8} {entry.effect:6g} {entry.right:6.3f} {entry.false:6.3f} "
            f"{entry.runs:6.1f} {entry.fixed_runs:6} {entry.saved:6.0%} {entry.informed_runs:9} "
            f"{entry.saved_of_informed:6.0%}"
        )
    print(
        f"best of ten: right {ten.right:.3f}, false {ten.false:.3f}, {ten.runs:.0f} runs, fixed plan {ten.fixed_runs}: "
        f"{ten.saved:.0%} saved"
    )
    held = all(entry.false <= LARGEST_ERROR and entry.saved >= LEAST_SAVED for entry in (*found, ten))
    verdict = "held" if held else "NOT held"
    print(f"false at most {LARGEST_ERROR:.0%} and saved at least {LEAST_SAVED:.0%} everywhere: {verdict}")


@dataclass(frozen=True, slots=True)
class Simulated:
    """One line of the table. ``runs`` is a mean; ``fixed_runs`` and ``informed_runs`` are the plans beside it."""

    noise: str
    datasets: int
    effect: float
    right: float
    false: float
    runs: float
    fixed_runs: int
    informed_runs: int

    @property
    def saved(self) -> float:
        """Share of the runs of the fixed plan."""
        return 1 - self.runs / self.fixed_runs

    @property
    def saved_of_informed(self) -> float:
        """Share of the runs of the plan that knows the difference."""
        return 1 - self.runs / self.informed_runs


def _normal(rng: np.random.Generator, shape: tuple[int, ...]) -> Numbers:
    return MEAN_M + SPREAD_M * rng.standard_normal(shape)


def _log_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> Numbers:
    sigma = math.sqrt(math.log1p((SPREAD_M / MEAN_M) ** 2))
    values: Numbers = MEAN_M * np.exp(sigma * rng.standard_normal(shape) - sigma**2 / 2)
    return values


def _failing(rng: np.random.Generator, shape: tuple[int, ...]) -> Numbers:
    values = _log_normal(rng, shape)
    values[rng.random(shape) < 0.1] = np.inf
    return values


@dataclass(frozen=True, slots=True)
class Noise:
    """Errors of runs, and the difference that matters: about as large as the standard deviation of a run."""

    draw: Callable[[np.random.Generator, tuple[int, ...]], Numbers]
    matters_m: float


NOISES = {
    "normal": Noise(_normal, SPREAD_M),
    "log-normal": Noise(_log_normal, SPREAD_M),
    "failures": Noise(_failing, 0.04),
}


def simulate(name: str, datasets: int, questions: int) -> list[Simulated]:
    """One line for each effect."""
    noise = NOISES[name]
    rng = np.random.default_rng(1)
    rule = RaceRule(Margin(noise.matters_m, relative=False), ERROR)
    lines = []
    for effect in EFFECTS:
        values = noise.draw(rng, (questions, 2, datasets, MOST_ROUNDS[datasets]))
        values[:, 1] += effect * noise.matters_m
        states = [race(rule, question) for question in values]
        rights = [_is_right(state.answer, state.left, effect) for state in states]
        falses = [
            state.answer is not RaceAnswer.OPEN and not right for state, right in zip(states, rights, strict=True)
        ]
        runs = [state.rounds * 2 * datasets for state in states]
        lines.append((effect, float(np.mean(rights)), float(np.mean(falses)), float(np.mean(runs)), values))
    powers = np.array([right for _, right, *_ in lines])
    fixed = [
        _rights_at_once(effect, values, noise.matters_m) >= power
        for (effect, _, _, _, values), power in zip(lines, powers, strict=True)
    ]
    per_round = 2 * datasets
    plan = _smallest(np.logical_and.reduce(fixed)) * per_round
    return [
        Simulated(name, datasets, effect, right, false, runs, plan, _smallest(enough) * per_round)
        for (effect, right, false, runs, _), enough in zip(lines, fixed, strict=True)
    ]


def _is_right(answer: RaceAnswer, left: Sequence[int], effect: float) -> bool:
    """Without a difference "the same" is right. Of two that differ, the better one is."""
    return answer is RaceAnswer.SAME if effect == 0 else answer is RaceAnswer.BEST and left == (0,)


def _smallest(enough: NDArray[np.bool_]) -> int:
    """The fewest runs that are enough at some level; ``enough`` is (levels, runs from 2). The most if none are."""
    found = np.flatnonzero(enough.any(axis=0))
    return int(found[0]) + 2 if len(found) else enough.shape[1] + 2


def _rights_at_once(effect: float, values: Numbers, matters_m: float) -> Numbers:
    """Share of right answers of one look, (levels, runs from 2); ``values`` are (questions, 2, datasets, runs)."""
    datasets, most = values.shape[2:]
    rights = np.empty((len(LEVELS), most - 1))
    for runs in range(2, most + 1):
        tables = values[..., :runs]
        if np.isinf(values).any():
            tables = np.array([counted(question, None) for question in tables])
        degrees, size = 2 * datasets * (runs - 1), datasets * runs / 2
        means = tables.mean(axis=(2, 3))
        difference = means[:, 1] - means[:, 0]
        error = np.sqrt(tables.var(axis=3, ddof=1).mean(axis=(1, 2)) / size)
        for row, level in enumerate(LEVELS):
            both, one = (scipy.special.stdtrit(degrees, 1 - level / sides) * error for sides in (2, 1))
            same = (np.abs(difference) <= both) & (np.abs(difference) + one <= matters_m)
            rights[row, runs - 2] = np.mean(same if effect == 0 else difference > both)
    return rights


def best_of_ten(questions: int) -> Simulated:
    """Ten algorithms on three datasets, each worse than the one before by half of what matters."""
    rng = np.random.default_rng(2)
    datasets, most = 3, 60
    rule = RaceRule(Margin(SPREAD_M, relative=False), ERROR)
    behind_m = np.arange(10) * SPREAD_M / 2
    right = false = 0
    runs: list[int] = []
    values = _log_normal(rng, (questions, 10, datasets, most)) + behind_m[:, None, None]
    for question in values:
        state = race(rule, question)
        runs.append(sum(lane.rounds for lane in state.lanes) * datasets)
        answered = state.answer is not RaceAnswer.OPEN
        fine = answered and 0 in state.left and all(behind_m[lane] <= SPREAD_M for lane in state.left)
        right, false = right + fine, false + (answered and not fine)
    power = right / questions
    plan = next((n for n in range(2, most) if _ten_at_once(values[..., :n], behind_m) >= power), most)
    total = plan * 10 * datasets
    return Simulated("log-normal", datasets, 0.5, power, false / questions, float(np.mean(runs)), total, total)


def _ten_at_once(tables: Numbers, behind_m: Numbers) -> float:
    """Share of the questions in which one look names the best of ten, and nobody who is worse than matters."""
    datasets, runs = tables.shape[2:]
    degrees, size = 2 * datasets * (runs - 1), datasets * runs / 2
    means, variances = tables.mean(axis=(2, 3)), tables.var(axis=3, ddof=1).mean(axis=2)
    both, one = (scipy.special.stdtrit(degrees, 1 - ERROR / 9 / sides) for sides in (2, 1))
    fine = 0
    for mean, variance in zip(means, variances, strict=True):
        error = np.sqrt((variance[:, None] + variance[None, :]) / 2 / size)
        gap = mean[:, None] - mean[None, :]
        left = np.flatnonzero(~(gap > both * error).any(axis=1))
        within = all(gap[a, b] + one * error[a, b] <= SPREAD_M for a in left for b in left if a != b)
        fine += within and 0 in left and bool((behind_m[left] <= SPREAD_M).all())
    return fine / len(means)


if __name__ == "__main__":
    main()
