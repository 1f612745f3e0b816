"""Ranks with ties: chance alone separates nobody, and what is clear is separated."""

from __future__ import annotations

import numpy as np
import pytest

from slamhive.analysis.statistics import bootstrap_mean, separated, standings

pytestmark = pytest.mark.integration  # scipy takes a second to load


def ranks(points, *, higher_wins=False, weights=None):
    rows = np.array(points, dtype=float)
    weights = np.ones(len(rows)) if weights is None else np.array(weights, dtype=float)
    return {entry.place: entry.rank for entry in standings(rows, weights, higher_wins=higher_wins, significance=0.05)}


def test_equal_competitors_share_a_rank_and_the_next_rank_counts_them():
    base = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    points = np.column_stack([base, base, base + np.linspace(1.0, 2.0, 7)])
    assert ranks(points) == {0: 1, 1: 1, 2: 3}


@pytest.mark.parametrize("higher_wins", [False, True])
def test_the_better_end_is_rank_one(higher_wins):
    points = np.column_stack([np.linspace(1, 2, 8), np.linspace(3, 5, 8)])
    found = ranks(points, higher_wins=higher_wins)
    assert found == ({0: 2, 1: 1} if higher_wins else {0: 1, 1: 2})


def test_a_small_mean_difference_that_changes_its_sign_separates_nobody():
    first = np.array([1.0, 1.2, 0.9, 1.1, 1.0, 1.3])
    second = first + np.array([0.2, -0.19, 0.21, -0.2, 0.22, -0.2])
    assert ranks(np.column_stack([first, second])) == {0: 1, 1: 1}


def test_few_sequences_need_differences_that_are_larger_than_their_spread():
    first = np.array([1.0, 2.0, 3.0])
    assert separated(first, first + np.array([1.0, 1.1, 0.9]), 0.05)
    assert not separated(
        first, first + np.array([0.1, 1.5, 0.7]), 0.05
    )  # all of one sign, which chance gives in a quarter
    assert separated(first, first + 0.5, 0.05)
    assert not separated(first[:1], first[:1] + 100, 0.05)


@pytest.mark.parametrize("sequences", [3, 8])
def test_equal_systems_are_rarely_separated_and_unequal_ones_mostly(sequences):
    random = np.random.default_rng(3)
    draw = random.normal(1, 0.1, (300, 2, sequences))
    assert np.mean([separated(first, second, 0.05) for first, second in draw]) < 0.09
    unequal = random.normal(1, 0.05, (50, 2, 8)) + np.array([0.0, 0.3])[:, None]
    assert np.mean([separated(first, second, 0.05) for first, second in unequal]) > 0.9


def test_weights_move_score_and_interval():
    points, weights = np.array([[1.0], [2.0], [4.0]]), np.array([8.0, 1.0, 1.0])
    (found,) = standings(points, weights, higher_wins=False, significance=0.05)
    assert found.score == pytest.approx(1.4)
    assert found.interval is not None
    assert found.interval == bootstrap_mean(points[:, 0], weights=weights)
    assert 1.0 <= found.interval.low < 1.4 < found.interval.high <= 4.0


def test_one_sequence_has_no_interval():
    (first, second) = standings(np.array([[1.0, 9.0]]), np.ones(1), higher_wins=False, significance=0.05)
    assert (first.rank, second.rank, first.interval) == (1, 1, None)
