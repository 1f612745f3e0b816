"""A search for the best of many candidates, each of which is a point of a grid, with noisy runs that may fail.

A Gaussian process over the grid (C. E. Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning, 2006,
chapters 2 and 5) says what a candidate's runs would give, from all runs of candidates like it. The next runs are those
of candidates that are best in samples of what is still possible (W. R. Thompson, Biometrika 25, 1933). So a candidate
is repeated while it may win, and no longer. The same samples say how far the best one may be from the truly best.

A failed run is never missing. Its share is estimated from the runs of like candidates, with weights that fall with the
distance. A candidate is judged by the mean of its scores, in which a failed run counts as the worst one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from slamhive.analysis.statistics import Numbers

Places = NDArray[np.intp]

SAMPLES = 400
_PROMISING, _LEADING = 150, 30
"""So many candidates are sampled together: those that may be best, and those that seem to be."""
_WEIGHT = 4.0
"""How fast the failures of other candidates lose weight with their squared distance."""
_FAILED_BEFORE, _GOOD_BEFORE = 0.01, 0.3
"""Runs that are thought to have been made before the first, so that a share is never 0 or 1."""
_JITTER = 1e-6


@dataclass(frozen=True, slots=True)
class SearchSpace:
    """The candidates as points.

    Attributes:
        codes: (candidates, axes). Values of an ordered axis are from 0 to 1; of others any numbers. NaN where an axis
        does
            not apply.
        ordered: For each axis, whether near values are alike.
    """

    codes: Numbers
    ordered: tuple[bool, ...]

    def squared(self, first: Places, second: Places) -> list[Numbers]:
        """The squared distances along each axis, (first, second); different values that have no order are at 1."""
        found = []
        for axis, ordered in enumerate(self.ordered):
            left, right = self.codes[first, axis][:, None], self.codes[second, axis][None, :]
            lacking = np.isnan(left), np.isnan(right)
            apart = (2 * (left - right)) ** 2 if ordered else (left != right).astype(float)
            found.append(np.where(lacking[0] | lacking[1], (lacking[0] != lacking[1]).astype(float), apart))
        return found


@dataclass(frozen=True, slots=True)
class SearchState:
    """Result of a search so far.

    Attributes:
        scores: (candidates,), the expected mean score; smaller is better.
        spread: (candidates,), its standard deviation.
        failing: (candidates,), the expected share of failed runs.
        best: The place of the smallest.
        gap: So far at most is the best one's score above that of the truly best, with the confidence asked for.
        expected_gap: The same on average: what going on may gain.
        importance: (axes,), the share of the variance of the scores that an axis explains alone.
        next: The places of the next runs, one for each; the same place may come twice.
    """

    scores: Numbers
    spread: Numbers
    failing: Numbers
    best: int
    gap: float
    expected_gap: float
    importance: tuple[float, ...]
    next: tuple[int, ...]


def first_places(candidates: int, seed: int) -> Places:
    """All places in a random order, in which the first runs are made."""
    return np.random.default_rng(seed).permutation(candidates)


def search(
    space: SearchSpace, places: Places, scores: Numbers, worst: float, confidence: float, at_once: int
) -> SearchState:
    """Fit the model to all runs.

    Args:
        space: The candidates.
        places: (runs,) of the candidates that ran.
        scores: (runs,), infinite for a failed run. Two good ones or more.
        worst: The score that a failed run counts as.
        confidence: Of ``gap``.
        at_once: How many runs are to come next.
    """
    rng = np.random.default_rng(len(scores))  # the same runs lead to the same next ones
    everywhere = np.arange(len(space.codes))
    good = np.isfinite(scores)
    tried, inverse, counts = np.unique(places[good], return_inverse=True, return_counts=True)
    means = np.bincount(inverse, scores[good]) / counts
    centre, scale = float(means.mean()), max(float(means.std()), 1e-9)
    process = _Process(space, tried, (means - centre) / scale, counts.astype(float))
    mean, deviation, lead = process.at(everywhere)
    failed, succeeded = _failures(space, places, good)
    failing = failed / (failed + succeeded)
    mean, deviation = centre + scale * mean, scale * deviation
    expected = (1 - failing) * mean + failing * worst
    near = np.unique(
        np.concatenate([np.argsort(expected - 2 * deviation)[:_PROMISING], np.argsort(expected)[:_LEADING]])
    )
    possible = mean[near][:, None] + scale * process.samples(near, lead, rng)
    shares = rng.beta(failed[near][:, None], succeeded[near][:, None], possible.shape)
    possible = (1 - shares) * possible + shares * worst
    best = int(np.argmin(expected[near]))
    gaps = possible[best] - possible.min(axis=0)
    winners = np.argmin(possible, axis=0)
    return SearchState(
        scores=expected,
        spread=deviation,
        failing=failing,
        best=int(near[best]),
        gap=float(np.quantile(gaps, confidence)),
        expected_gap=float(gaps.mean()),
        importance=_importance(space, expected),
        next=tuple(int(near[winner]) for winner in winners[:at_once]),
    )


def _failures(space: SearchSpace, places: Places, good: NDArray[np.bool_]) -> tuple[Numbers, Numbers]:
    """The numbers of failed and of good runs at each candidate, those of others with weights below 1."""
    distances = sum(space.squared(np.arange(len(space.codes)), places))
    weights = np.exp(-0.5 * _WEIGHT * distances)
    return (weights * ~good).sum(axis=1) + _FAILED_BEFORE, (weights * good).sum(axis=1) + _GOOD_BEFORE


def _importance(space: SearchSpace, scores: Numbers) -> tuple[float, ...]:
    """The variance of the means over each value of an axis, by the whole variance (I. M. Sobol, 1993, first order)."""
    whole = float(scores.var())
    shares = []
    for axis in range(space.codes.shape[1]):
        codes = np.nan_to_num(space.codes[:, axis], nan=-1.0)
        _, inverse, counts = np.unique(codes, return_inverse=True, return_counts=True)
        means = np.bincount(inverse, scores) / counts
        between = float((counts * (means - scores.mean()) ** 2).sum()) / len(scores)
        shares.append(between / whole if whole > 0 else 0.0)
    return tuple(shares)


class _Process:
    """A Gaussian process with one length for each axis, fitted to means of runs by its marginal likelihood.

    Each candidate also has a deviation of its own, which its own runs alone can show.

    Args:
        space: The candidates.
        tried: (n,) places.
        means: (n,) of their runs, standardised.
        counts: (n,) of their runs.
    """

    def __init__(self, space: SearchSpace, tried: Places, means: Numbers, counts: Numbers) -> None:
        self._space, self._tried, self._counts = space, tried, counts
        self._axes = len(space.ordered)
        self._between = space.squared(tried, tried)
        self._means = means
        self._expected = np.array([0.0] * self._axes + [0.0, math.log(0.1), math.log(0.2)])
        bounds = [(-2.5, 3.0)] * self._axes + [(-2.0, 2.0), (-4.0, 0.0), (-4.0, 1.0)]
        fitted = scipy.optimize.minimize(
            self._cost, self._expected, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 25}
        )
        self._logs = fitted.x
        self._factor = self._cholesky(self._logs)
        self._weights = scipy.linalg.solve_triangular(self._factor, means, lower=True)

    def _kernel(self, logs: Numbers, squared: Sequence[Numbers]) -> Numbers:
        total = sum(math.exp(-2 * log) * distances for log, distances in zip(logs, squared, strict=False))
        kernel: Numbers = math.exp(2 * logs[self._axes]) * np.exp(-0.5 * np.asarray(total))
        return kernel

    def _cholesky(self, logs: Numbers) -> Numbers:
        matrix = self._kernel(logs, self._between)
        own = math.exp(2 * logs[self._axes + 1])
        matrix[np.diag_indices(len(matrix))] += own + math.exp(2 * logs[-1]) / self._counts + _JITTER
        return np.asarray(np.linalg.cholesky(matrix), dtype=float)

    def _cost(self, logs: Numbers) -> tuple[float, Numbers]:
        """The negative logarithm of the posterior of lengths, signal, own and noise, and its gradient (section 5.4.1).

        Their priors are log-normal.
        """
        kernel = self._kernel(logs, self._between)
        own, noise = math.exp(2 * logs[self._axes + 1]), math.exp(2 * logs[-1]) / self._counts
        factor = scipy.linalg.cholesky(kernel + np.diag(own + noise + _JITTER), lower=True)
        inverse = scipy.linalg.cho_solve((factor, True), np.eye(len(kernel)))
        solved = inverse @ self._means
        pull = inverse - np.outer(solved, solved)
        weighted = pull * kernel
        distance = logs - self._expected
        slopes = [
            *(
                0.5 * math.exp(-2 * log) * float((weighted * apart).sum())
                for log, apart in zip(logs, self._between, strict=False)
            ),
            float(weighted.sum()),
            own * float(np.trace(pull)),
            float((np.diag(pull) * noise).sum()),
        ]
        cost = 0.5 * float(self._means @ solved) + float(np.log(np.diag(factor)).sum())
        return cost + 0.5 * float(distance @ distance), np.array(slopes) + distance

    def at(self, places: Places) -> tuple[Numbers, Numbers, Numbers]:
        """Mean and standard deviation at these places, and what :meth:`samples` takes."""
        own = math.exp(2 * self._logs[self._axes + 1])
        across = self._kernel(self._logs, self._space.squared(self._tried, places))
        across += own * (self._tried[:, None] == places[None, :])
        lead = scipy.linalg.solve_triangular(self._factor, across, lower=True)
        variance = np.maximum(math.exp(2 * self._logs[self._axes]) + own - (lead**2).sum(axis=0), 1e-12)
        return lead.T @ self._weights, np.sqrt(variance), lead

    def samples(self, places: Places, lead: Numbers, rng: np.random.Generator) -> Numbers:
        """Deviations from the mean, (places, samples)."""
        part = lead[:, places]
        covariance = self._kernel(self._logs, self._space.squared(places, places)) - part.T @ part
        covariance[np.diag_indices(len(places))] += math.exp(2 * self._logs[self._axes + 1]) + _JITTER
        factor = np.linalg.cholesky(covariance)
        drawn: Numbers = factor @ rng.standard_normal((len(places), SAMPLES))
        return drawn
