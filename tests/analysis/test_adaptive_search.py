"""The search for the best of many candidates: its model, its next runs, and what it says of the best one."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from scipy.optimize import check_grad

from slamhive.analysis.adaptive_search import (
    SearchAim,
    SearchRuns,
    SearchSpace,
    _Process,
    first_places,
    front_of,
    search,
)
from slamhive.analysis.statistics import Numbers

pytestmark = pytest.mark.integration  # scipy takes a second to load

GRID = np.array(list(product(range(2), range(6), range(6))), dtype=float)
SPACE = SearchSpace(GRID / np.array([1, 5, 5]), (False, True, True))


def truth(failing_system: int | None = None) -> tuple[Numbers, Numbers]:
    """Scores with an optimum of its own in each system, and the shares of failed runs."""
    optimum = np.where(GRID[:, 0] == 0, 1, 4)
    scores = -3 + 0.1 * (GRID[:, 1] - optimum) ** 2 + 0.05 * (GRID[:, 2] - 3) ** 2 + 0.3 * GRID[:, 0]
    return scores, np.where(GRID[:, 0] == failing_system, 0.8, 0.0)


def searched(rng: np.random.Generator, scores: Numbers, failing: Numbers, runs: int):
    places = [int(place) for place in first_places(len(GRID), 0)[:16]]
    found: list[float] = []
    while True:
        for place in places[len(found) :]:
            failed = rng.random() < failing[place]
            found.append(math.inf if failed else scores[place] + 0.1 * rng.standard_normal())
        state = search(SPACE, SearchRuns(np.array(places), np.array(found)[:, None], np.zeros(1)), SearchAim(0.95, 4))
        if len(found) >= runs:
            return state, places
        places += state.next


def test_the_best_is_found_with_a_share_of_the_runs():
    scores, failing = truth()
    state, places = searched(np.random.default_rng(0), scores, failing, 48)
    assert scores[state.front[0]] - scores.min() <= 0.06
    assert len(set(places[16:])) < len(places[16:]), "what may win is repeated"
    assert np.mean(scores[places[32:]]) < np.mean(scores[places[:16]])


def test_the_gap_holds_what_the_truth_is():
    scores, failing = truth()
    held = 0
    for seed in range(10):
        state, _ = searched(np.random.default_rng(seed), scores, failing, 40)
        held += scores[state.front[0]] - scores.min() <= state.gap
        assert state.gap >= 0 <= state.expected_gap
    assert held >= 9


def test_failures_keep_a_system_from_being_best():
    scores, failing = truth(failing_system=0)
    state, _ = searched(np.random.default_rng(1), scores, failing, 48)
    assert GRID[state.front[0], 0] == 1
    assert state.failing[GRID[:, 0] == 0].mean() > 0.4
    assert state.failing[state.front[0]] < 0.1


def test_the_same_runs_lead_to_the_same_next_ones():
    rng = np.random.default_rng(0)
    places, scores = np.arange(20), rng.standard_normal(20)
    first, second = (
        search(SPACE, SearchRuns(places, scores[:, None], np.array([5.0])), SearchAim(0.95, 4)) for _ in range(2)
    )
    assert first.next == second.next
    assert first.gap == second.gap


def test_the_axis_that_decides_is_the_most_important():
    scores, failing = truth()
    state, _ = searched(np.random.default_rng(2), scores, failing, 60)
    (importance,) = state.importance
    assert importance[1] == max(importance)
    assert all(0 <= share <= 1 for share in importance)


def test_an_axis_that_does_not_apply_is_as_far_as_another_value():
    space = SearchSpace(np.array([[0.0, math.nan], [1.0, 0.5]]), (False, True))
    squared = space.squared(np.arange(2), np.arange(2))
    assert squared[1].tolist() == [[0.0, 1.0], [1.0, 0.0]]
    assert squared[0].tolist() == [[0.0, 1.0], [1.0, 0.0]]


def test_the_gradient_of_the_likelihood_is_right():
    rng = np.random.default_rng(0)
    process = _Process(SPACE, np.arange(12), rng.standard_normal(12), np.ones(12))
    at = process._expected + 0.1 * rng.standard_normal(6)
    assert check_grad(lambda logs: process._cost(logs)[0], lambda logs: process._cost(logs)[1], at) < 1e-4


def test_the_front_holds_what_none_is_better_than_in_everything():
    scores = np.array([[3.0, 1.0], [1.0, 3.0], [2.0, 2.0], [3.0, 3.0], [1.0, 3.0]])
    assert front_of(scores).tolist() == [1, 2, 0]


def test_a_long_front_is_shortened_where_it_lacks_least():
    along = np.linspace(0, 1, 60)
    front = front_of(np.column_stack([along, -along]))
    assert (len(front), front[0], front[-1]) == (40, 0, 59)


def test_the_best_trade_offs_of_two_objectives_are_found():
    scores, _failing = truth()
    both = np.column_stack([scores, 0.4 * GRID[:, 1]])  # more of the second axis costs more
    rng = np.random.default_rng(3)
    places = [int(place) for place in first_places(len(GRID), 0)[:16]]
    found: list[Numbers] = []
    for _ in range(12):
        found += [both[place] + 0.05 * rng.standard_normal(2) for place in places[len(found) :]]
        state = search(SPACE, SearchRuns(np.array(places), np.array(found), np.full(2, 5.0)), SearchAim(0.95, 4))
        places += state.next
    lacking = (both[list(state.front)][:, None] - both[None]).max(axis=2).min(axis=0).max()
    assert lacking <= 0.1
    assert set(GRID[list(state.front), 1]) >= {0.0, 1.0}, "the cheap ones, and the good ones"
    assert np.argmax(state.importance[1]) == 1


def test_a_candidate_that_fails_too_often_is_not_the_best():
    scores, _failing = truth()
    rng = np.random.default_rng(4)
    places = np.tile(np.arange(len(GRID)), 3)
    failed = (GRID[places, 0] == 0) & (rng.random(len(places)) < 0.3)
    found = np.where(failed, np.inf, scores[places])[:, None]
    runs = SearchRuns(places, found, np.array([-2.5]))
    assert GRID[search(SPACE, runs, SearchAim(0.95, 4)).front[0], 0] == 0
    strict = search(SPACE, runs, SearchAim(0.95, 4, allowed_failing=0.05))
    assert not failed[places == strict.front[0]].any()


def test_failures_can_be_traded_against_the_error():
    scores, _ = truth()
    places = np.tile(np.arange(len(GRID)), 4)
    turn = np.repeat(np.arange(4), len(GRID))
    found = np.where((GRID[places, 0] == 0) & (turn == 0), np.inf, scores[places])[:, None]
    state = search(SPACE, SearchRuns(places, found, np.array([-2.9])), SearchAim(0.95, 4, failing_counts=True))
    assert {0.0, 1.0} == set(GRID[list(state.front), 0])
    assert state.scores.shape == (len(GRID), 2)
