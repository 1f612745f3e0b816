"""Tables of configurations whose truth is known, in which searches are measured.

The *tuning* tables are those on which the model of ``slamhive experiment optimise`` was chosen, with the seeds 0 to 19.
The *held-out* tables differ from them in everything but their size. Effects saturate, break off or jump, all pairs of
axes interact, the noise has heavy tails, and failures lie behind a cliff. Nothing was chosen on them.
The *real* tables are the 195 runs of ``docs/results``. Each of 33 algorithms in a room, or of 6 in a street, ran five
times, and a further run is one of these five.
"""

from __future__ import annotations

import json
import math
import tarfile
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slamhive.analysis.adaptive_search import SearchSpace

Numbers = NDArray[np.float64]

WORST_M = 1.0
TUNING_SIZES = (3, 5, 5, 5, 4)
HELD_OUT_SIZES = (4, 5, 5, 5, 3)
RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results" / "trajectories.tar.xz"


@dataclass(frozen=True, slots=True)
class SearchTable:
    """All configurations of an experiment.

    Attributes:
        grid: (n, axes), their places on the axes; the first axis is the system.
        ordered: For each axis, whether its values have an order.
        log_mean: (n,), the mean logarithm of the error (m) of good runs.
        deviation: (n,), its standard deviation.
        failing: (n,), the share of failed runs.
        log_cost: (n,), the mean logarithm of the CPU use (cores).
        heavy: The noise has Student's t distribution with 4 degrees of freedom, else a normal one.
        log_clip: (n,), the mean logarithm of the error of clips.
        drawn: (n, repeats), real runs, of which a further one is drawn; infinite for a failed run.
    """

    grid: NDArray[np.intp]
    ordered: tuple[bool, ...]
    log_mean: Numbers
    deviation: Numbers
    failing: Numbers
    log_cost: Numbers
    heavy: bool = False
    drawn: Numbers | None = None
    log_clip: Numbers | None = None

    def with_clips(self, rho: float, seed: int) -> SearchTable:
        """The table with clips whose mean logarithm of the error correlates with that of whole runs by ``rho``."""
        mean, spread = self.log_mean.mean(), self.log_mean.std()
        other = np.random.default_rng(5000 + seed).standard_normal(len(self.grid))
        clips = mean + rho * (self.log_mean - mean) + math.sqrt(1 - rho**2) * spread * other
        return replace(self, log_clip=clips)

    def draw_clip(self, place: int, rng: np.random.Generator) -> float:
        """The logarithm of the error of a clip, as noisy as a whole run; infinite if it failed, half as often."""
        assert self.log_clip is not None
        if rng.random() < self.failing[place] / 2:
            return math.inf
        return float(self.log_clip[place] + self.deviation[place] * rng.standard_normal())

    @property
    def space(self) -> SearchSpace:
        """The configurations as the search sees them."""
        return SearchSpace(self.grid / np.maximum(1, self.grid.max(axis=0)), self.ordered)

    @property
    def scores(self) -> Numbers:
        """(n, 2), the mean logarithms of error and CPU use; a failed run counts as the worst."""
        means = np.column_stack([self.log_mean, self.log_cost])
        scores: Numbers = (1 - self.failing[:, None]) * means + self.failing[:, None] * self.worst
        return scores

    @property
    def worst(self) -> Numbers:
        """(2,), what a failed run counts as: 1 m, and 8 cores."""
        return np.array([math.log(WORST_M), math.log(8.0)])

    def draw(self, place: int, rng: np.random.Generator) -> Numbers:
        """(2,), the logarithms of error and CPU use of one run; infinite if it failed."""
        if self.drawn is not None:
            return np.array([rng.choice(self.drawn[place]), 0.0])
        if rng.random() < self.failing[place]:
            return np.array([math.inf, math.inf])
        noise = rng.standard_t(4) / math.sqrt(2) if self.heavy else rng.standard_normal()
        error = self.log_mean[place] + self.deviation[place] * noise
        return np.array([error, self.log_cost[place] + 0.05 * rng.standard_normal()])

    def behind(self, place: int) -> float:
        """By which share the error of a configuration is above that of the best."""
        return float(np.expm1(self.scores[place, 0] - self.scores[:, 0].min()))


def tuning_table(seed: int) -> SearchTable:
    """A table of the kind that the search was tuned on."""
    rng = np.random.default_rng(seed)
    grid = np.array(list(product(*map(range, TUNING_SIZES))))
    share = grid / (np.array(TUNING_SIZES) - 1)
    system = grid[:, 0]
    optimum, curvature = rng.uniform(0.3, 0.9, (3, 4)), rng.uniform(0.4, 1.6, (3, 4))
    log_mean = np.log(np.array([0.05, 0.06, 0.09]))[system]
    for axis in range(4):
        log_mean = log_mean + curvature[system, axis] * (share[:, axis + 1] - optimum[system, axis]) ** 2
    together = (share[:, 1] - optimum[system, 0]) * (share[:, 2] - optimum[system, 1])
    log_mean = log_mean + rng.uniform(0.2, 0.6) * together + 0.03 * rng.standard_normal(len(grid))
    everywhere = np.array([0.0, 0.01, 0.05])[system]
    starved = np.maximum(0, 0.35 - share[:, 1]) + 0.8 * np.maximum(0, 0.3 - share[:, 2])
    failing = np.clip(everywhere + starved, 0, 0.95)
    deviation = np.array([0.10, 0.08, 0.15])[system]
    return SearchTable(grid, (False, *[True] * 4), log_mean, deviation, failing, _cost(share, system))


def held_out_table(seed: int) -> SearchTable:
    """A table of another kind."""
    rng = np.random.default_rng(seed)
    grid = np.array(list(product(*map(range, HELD_OUT_SIZES))))
    share = grid / (np.array(HELD_OUT_SIZES) - 1)
    system = grid[:, 0]
    log_mean = np.log(rng.uniform(0.03, 0.08, 4))[system]
    slope, steep = rng.uniform(0.4, 1.2, 4), rng.uniform(2, 8, 4)
    log_mean = log_mean + slope[system] * np.exp(-steep[system] * share[:, 1])  # more of it helps, less and less
    bend, at = rng.uniform(0.5, 1.5, 4), rng.uniform(0.2, 1.0, 4)
    log_mean = log_mean + bend[system] * np.abs(share[:, 2] - at[system])
    log_mean = log_mean + rng.normal(0, 0.25, (4, HELD_OUT_SIZES[3]))[system, grid[:, 3]]  # no order at all
    log_mean = log_mean + rng.uniform(0, 1.0, 4)[system] * (share[:, 4] - 0.5) ** 2
    for first, second in combinations(range(1, 5), 2):
        log_mean = log_mean + rng.normal(0, 0.3) * (share[:, first] - 0.5) * (share[:, second] - 0.5)
    log_mean = log_mean + 0.04 * rng.standard_normal(len(grid))
    everywhere = rng.uniform(0, 0.04, 4)[system]
    across = share[:, 1:] @ rng.uniform(0.2, 1.0, 4)
    cliff = 0.6 / (1 + np.exp(25 * (across - np.quantile(across, 0.2))))
    deviation = rng.uniform(0.05, 0.25, 4)[system] * (1 + 0.5 * share[:, 2])
    return SearchTable(
        grid,
        (False, *[True] * 4),
        log_mean,
        deviation,
        np.clip(everywhere + cliff, 0, 0.95),
        _cost(share, system),
        heavy=True,
    )


def _cost(share: Numbers, system: NDArray[np.intp]) -> Numbers:
    """The mean logarithm of the CPU use: it grows with the first three axes below the system."""
    cost: Numbers = np.log(0.5) + 0.15 * system + 0.6 * share[:, 1] + 0.4 * share[:, 2] + 0.3 * share[:, 3]
    return cost


def real_table(dataset: str) -> SearchTable:
    """The runs of ``docs/results`` on a dataset: ``room`` or ``kitti_06``. A failed run counts as 1 m."""
    with tarfile.open(RESULTS) as archive:
        content = archive.extractfile("runs.json")
        assert content is not None
        runs = [run for run in json.load(content) if run["dataset"] == dataset]
    names = sorted({run["algorithm"] for run in runs})
    errors: dict[str, list[float]] = {name: [] for name in names}
    for run in runs:
        good = run["verdict"] == "good" and run["ate_rmse_m"] is not None
        errors[run["algorithm"]].append(math.log(run["ate_rmse_m"]) if good else math.inf)
    drawn = np.array([errors[name] for name in names])
    good = np.isfinite(drawn)
    failing = 1 - good.mean(axis=1)
    log_mean = np.where(good, drawn, 0).sum(axis=1) / np.maximum(1, good.sum(axis=1))
    nothing = np.zeros(len(names))
    grid = np.arange(len(names))[:, None]
    return SearchTable(grid, (False,), log_mean, nothing, failing, nothing, drawn=drawn)
