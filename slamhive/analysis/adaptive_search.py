"""A search for the best of many candidates, each of which is a point of a grid, with noisy runs that may fail.

A Gaussian process over the grid (C. E. Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning, 2006,
chapters 2 and 5) says what a candidate's runs would give, from all runs of candidates like it. The next runs are those
of candidates that are best in samples of what is still possible (W. R. Thompson, Biometrika 25, 1933). So a candidate
is repeated while it may win, and no longer. The same samples say how far the best one may be from the truly best.

With several objectives each has a process of its own. What is sought is the front: the candidates of which none is
worse than another one in all objectives. How far the front may be from the true one is the additive epsilon indicator
(E. Zitzler et al., IEEE Transactions on Evolutionary Computation 7, 2003). It is what must be taken off the scores of
all of its candidates until no sampled candidate is better in all objectives. With one objective this is the distance
from the best.

A failed run is never missing. Its share is estimated from the runs of like candidates, with weights that fall with the
distance. A candidate is judged by the mean of its scores, in which a failed run counts as the worst one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from slamhive.analysis.statistics import Numbers

Places = NDArray[np.intp]

SAMPLES = 400
_PROMISING, _LEADING = 150, 30
"""So many candidates are sampled together: those that may be best, and those that seem to be."""
MOST_ON_FRONT = 40
"""Of a longer front, those candidates are looked at without which it would lack most."""
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
        scores: (candidates, objectives), the expected mean scores; smaller is better.
        spread: (candidates, objectives), their standard deviations.
        failing: (candidates,), the expected share of failed runs.
        front: The places of the best trade-offs, those that are best in the first objective first. With one objective
            it is the best candidate alone.
        gap: So far at most is the front from the true one, with the confidence asked for.
        expected_gap: The same on average: what going on may gain.
        importance: (objectives, axes), the share of the variance of the scores that an axis explains alone.
        next: The places of the next runs, one for each; the same place may come twice.
    """

    scores: Numbers
    spread: Numbers
    failing: Numbers
    front: tuple[int, ...]
    gap: float
    expected_gap: float
    importance: tuple[tuple[float, ...], ...]
    next: tuple[int, ...]


def first_places(candidates: int, seed: int) -> Places:
    """All places in a random order, in which the first runs are made."""
    return np.random.default_rng(seed).permutation(candidates)


@dataclass(frozen=True, slots=True)
class SearchRuns:
    """The runs of a search so far.

    Attributes:
        places: (runs,) of the candidates that ran.
        scores: (runs, objectives), infinite for a failed run. Two good ones or more.
        worst: (objectives,), the scores that a failed run counts as.
        pending: The number of runs under way: other runs come next than without them.
    """

    places: Places
    scores: Numbers
    worst: Numbers
    pending: int = 0


@dataclass(frozen=True, slots=True)
class SearchAim:
    """The question of a search.

    Attributes:
        confidence: Of the gap.
        at_once: How many runs are to come next.
        failing_counts: The share of failed runs is a further objective, the last one.
        allowed_failing: A candidate counts as failing always once a larger share of its own runs has failed; None
            allows any.
    """

    confidence: float
    at_once: int
    failing_counts: bool = False
    allowed_failing: float | None = None


def promoted(looks: Mapping[int, float], keep: float) -> list[int]:
    """The places whose first looks are among the best ``keep`` of all, the best first: they may run in full.

    Asynchronous successive halving with two rungs (L. Li et al., MLSys 2020): nobody waits for the last look, and a
    place that is behind later keeps what it was given. A first look only ranks, so its score enters no model.

    Args:
        looks: {place: score}, smaller is better; infinite where the look failed, which is never promoted.
        keep: Share of the looks.
    """
    order = sorted((score, place) for place, score in looks.items())
    return [place for score, place in order[: math.floor(keep * len(order) + 1e-9)] if math.isfinite(score)]


def search(space: SearchSpace, runs: SearchRuns, aim: SearchAim) -> SearchState:
    """Fit the model to all runs, and say what may be best and which runs come next."""
    places, scores, worst = runs.places, runs.scores, runs.worst
    rng = np.random.default_rng(len(scores) + runs.pending)  # the same runs lead to the same next ones
    good: NDArray[np.bool_] = np.asarray(np.isfinite(scores).all(axis=1))
    tried, inverse, counts = np.unique(places[good], return_inverse=True, return_counts=True)
    failed, succeeded = _failures(space, places, good)
    failing = failed / (failed + succeeded)
    # Candidates of which a larger share of their own runs has failed than is allowed, (candidates,).
    own, own_failed = (np.bincount(chosen, minlength=len(space.codes)) for chosen in (places, places[~good]))
    most_failed = math.inf if aim.allowed_failing is None else aim.allowed_failing * own
    out: NDArray[np.bool_] = own_failed > most_failed
    counted = np.where(out, 1.0, failing)
    objectives = [
        _Objective(space, tried, np.bincount(inverse, values[good]) / counts, counts.astype(float))
        for values in scores.T
    ]
    mean = np.column_stack([objective.mean for objective in objectives])
    deviation = np.column_stack([objective.deviation for objective in objectives])
    expected = (1 - counted[:, None]) * mean + counted[:, None] * worst
    if aim.failing_counts:
        expected = np.column_stack([expected, counted])
        share = np.sqrt(failing * (1 - failing) / (failed + succeeded + 1))
        deviation = np.column_stack([deviation, share])
    front = front_of(expected)
    lacking = _lacking(expected[front], expected - 2 * deviation)
    seeming = _lacking(expected[front], expected)
    near = np.unique(np.concatenate([np.argsort(-lacking)[:_PROMISING], np.argsort(-seeming)[:_LEADING], front]))
    possible = np.stack([objective.samples(near, rng) for objective in objectives])  # (objectives, near, samples)
    shares = rng.beta(failed[near][:, None], succeeded[near][:, None], possible.shape[1:])
    shares[out[near]] = 1.0
    possible = (1 - shares) * possible + shares * worst[:, None, None]
    if aim.failing_counts:
        possible = np.concatenate([possible, shares[None]])
    gaps, winners = _behind(possible, np.searchsorted(near, front), rng)
    return SearchState(
        scores=expected,
        spread=deviation,
        failing=failing,
        front=tuple(map(int, front)),
        gap=float(np.quantile(gaps, aim.confidence)),
        expected_gap=float(gaps.mean()),
        importance=tuple(_importance(space, values) for values in expected.T),
        next=tuple(int(near[winner]) for winner in winners[: aim.at_once]),
    )


def front_of(scores: Numbers) -> Places:
    """The places of (n, objectives) that no other one is better than in all objectives, the best in the first first.

    Of equal ones the first counts. Of a long front, only :data:`MOST_ON_FRONT` are kept.
    """
    order = np.lexsort([np.arange(len(scores)), *reversed(scores.T)])
    kept: list[int] = []
    for place in order:
        if not (scores[kept] <= scores[place]).all(axis=1).any():
            kept.append(int(place))
    while len(kept) > MOST_ON_FRONT:
        short = [_lacking(scores[kept[:i] + kept[i + 1 :]], scores[[place]])[0] for i, place in enumerate(kept)]
        del kept[int(np.argmin(short))]
    return np.array(kept, dtype=np.intp)


def _lacking(front: Numbers, scores: Numbers) -> Numbers:
    """(n,), by how much each of (n, objectives) is better than any of the front in all objectives.

    Negative behind the front.
    """
    found: Numbers = (front[:, None, :] - scores[None, :, :]).max(axis=2).min(axis=0)
    return found


def _behind(possible: Numbers, front: Places, rng: np.random.Generator) -> tuple[Numbers, Places]:
    """By how much the front lacks in each sample of (objectives, candidates, samples), and the place that shows it.

    If it lacks nothing, the place is one of the front, by chance.
    """
    size = possible.shape[2]
    lacking = np.full(possible.shape[1:], math.inf)
    for member in front:
        lacking = np.minimum(lacking, (possible[:, [member], :] - possible).max(axis=0))
    winners = np.argmax(lacking, axis=0)
    gaps = np.maximum(lacking[winners, np.arange(size)], 0.0)
    known = gaps <= 0
    winners[known] = rng.choice(front, int(known.sum()))
    return gaps, winners


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


class _Objective:
    """One objective: its mean and standard deviation at each candidate, and samples of what is still possible.

    Args: as of :class:`_Process`, with means that are not standardised.
    """

    def __init__(self, space: SearchSpace, tried: Places, means: Numbers, counts: Numbers) -> None:
        centre, self._scale = float(means.mean()), max(float(means.std()), 1e-9)
        self._process = _Process(space, tried, (means - centre) / self._scale, counts)
        mean, deviation, self._lead = self._process.at(np.arange(len(space.codes)))
        self.mean, self.deviation = centre + self._scale * mean, self._scale * deviation

    def samples(self, places: Places, rng: np.random.Generator) -> Numbers:
        """Draw (places, samples)."""
        drawn: Numbers = self.mean[places][:, None] + self._scale * self._process.samples(places, self._lead, rng)
        return drawn


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
        matrix = self._kernel(self._logs, self._between)
        own = math.exp(2 * self._logs[self._axes + 1])
        matrix[np.diag_indices(len(matrix))] += own + math.exp(2 * self._logs[-1]) / self._counts + _JITTER
        self._factor = np.asarray(np.linalg.cholesky(matrix), dtype=float)
        self._weights = scipy.linalg.solve_triangular(self._factor, means, lower=True)

    def _kernel(self, logs: Numbers, squared: Sequence[Numbers]) -> Numbers:
        total = sum(math.exp(-2 * log) * distances for log, distances in zip(logs, squared, strict=False))
        kernel: Numbers = math.exp(2 * logs[self._axes]) * np.exp(-0.5 * np.asarray(total))
        return kernel

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
