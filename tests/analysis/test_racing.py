"""Races between candidates: who leaves, when they end, and how seldom they err."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamhive.analysis.racing import RaceAnswer, RaceRule, RaceState, counted, half_width_factor, race
from slamhive.analysis.statistics import Numbers
from slamhive.domain.gate import Margin

pytestmark = pytest.mark.integration  # scipy takes a second to load

CENTIMETRE = RaceRule(Margin(0.01, relative=False))


def errors_m(rng: np.random.Generator, mean_m: float, runs: int, datasets: int = 1) -> list[Numbers]:
    return list(rng.normal(mean_m, 0.01, (datasets, runs)))


def of(*means_m: float, seed: int = 0, runs: int = 120, datasets: int = 1, rule: RaceRule = CENTIMETRE) -> RaceState:
    rng = np.random.default_rng(seed)
    return race(rule, [errors_m(rng, mean_m, runs, datasets) for mean_m in means_m])


def test_the_better_of_two_wins_after_few_rounds():
    state = of(0.09, 0.05)
    assert (state.answer, state.left) == (RaceAnswer.BEST, (1,))
    assert state.lanes[0].beaten_by == 1
    assert 2 < state.rounds < 12


def test_two_that_are_equal_end_without_a_difference_that_matters():
    state = of(0.05, 0.05)
    assert state.answer is RaceAnswer.SAME
    assert set(state.left) == {0, 1}
    assert all(pair.value + pair.one_sided <= 0.01 for pair in state.pairs)


def test_the_best_of_ten_keeps_only_those_that_may_be_best_running():
    state = of(*(0.05 + 0.02 * place for place in range(10)), runs=40, datasets=2)
    assert state.left == (0,)
    assert state.lanes[9].rounds < state.rounds
    assert all(lane.beaten_by is not None for lane in state.lanes[1:])


def test_the_same_runs_give_the_same_state_whoever_looks():
    rng = np.random.default_rng(3)
    scores = [errors_m(rng, mean_m, 30) for mean_m in (0.05, 0.06)]
    whole = race(CENTIMETRE, scores)
    cut = race(CENTIMETRE, [[values[: whole.rounds] for values in lane] for lane in scores])
    assert cut == whole
    before = race(CENTIMETRE, [[values[: whole.rounds - 1] for values in lane] for lane in scores])
    assert before.answer is RaceAnswer.OPEN


def test_a_round_counts_when_all_datasets_have_run():
    state = race(CENTIMETRE, [[np.array([0.1] * 9), np.array([0.1] * 2)], [np.array([0.5] * 9), np.array([0.5] * 9)]])
    assert state.rounds == 2


def test_a_failed_run_counts_as_twice_the_worst_good_one():
    first, second = counted([[np.array([0.1, math.inf])], [np.array([0.2, 0.3])]], None)
    assert first.tolist() == [[0.1, 0.6]]
    assert second.tolist() == [[0.2, 0.3]]


def test_where_more_is_better_a_failed_run_counts_as_nothing():
    (first,) = counted([[np.array([-0.9, math.inf, -0.5])]], None)
    assert first.tolist() == [[-0.9, 0.0, -0.5]]


def test_a_stated_worst_counts_and_a_dataset_without_a_good_run_separates_nobody():
    (first,) = counted([[np.array([0.1, math.inf])]], 2.0)
    assert first.tolist() == [[0.1, 2.0]]
    (none,) = counted([[np.array([math.inf, math.inf])]], None)
    assert none.tolist() == [[0.0, 0.0]]


def test_candidates_that_always_fail_lose():
    failing = [np.full(30, np.inf)]
    state = race(CENTIMETRE, [failing, errors_m(np.random.default_rng(0), 0.05, 30)])
    assert (state.answer, state.left) == (RaceAnswer.BEST, (1,))


def test_a_share_is_one_of_the_smaller_mean():
    state = of(0.05, 0.05, rule=RaceRule(Margin(0.2)))
    assert state.pairs[0].matters == pytest.approx(0.2 * min(lane.mean or 0 for lane in state.lanes))


def test_the_interval_solves_the_bayes_factor():
    """Of Gönen et al. (2005), equation 6, with a prior of variance 1."""
    for degrees, size, error in ((6, 2.0, 0.05), (40, 12.0, 0.01)):
        t = half_width_factor(degrees, size, error)
        factor = (1 + size) ** -0.5 * ((1 + t**2 / degrees) / (1 + t**2 / (degrees * (1 + size)))) ** (
            (degrees + 1) / 2
        )
        assert factor == pytest.approx(1 / error)
    assert math.isinf(half_width_factor(2, 1.0, 0.05))
    assert math.isinf(half_width_factor(0, 0.5, 0.05))


@pytest.mark.parametrize("effect_m", [0.0, 0.01, 0.02])
def test_false_answers_stay_below_the_stated_error(effect_m: float):
    rng = np.random.default_rng(11)
    false = 0
    for _ in range(200):
        state = race(CENTIMETRE, [errors_m(rng, 0.05, 80), errors_m(rng, 0.05 + effect_m, 80)])
        right = state.answer is RaceAnswer.SAME if effect_m == 0 else state.left == (0,)
        false += state.answer is not RaceAnswer.OPEN and not right
    assert false <= 0.05 * 200
