"""Equivalence: known p values, both directions, single recorded values, and rates of false answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from slamhive.analysis.regression import (
    FailureCounts,
    Sample,
    failure_equivalence,
    median_interval,
    rank_equivalence,
    rank_evidence,
)
from slamhive.analysis.statistics import Interval
from slamhive.domain.gate import SIGNIFICANCE, Margin

pytestmark = pytest.mark.integration  # scipy takes a second to load

TEN = Margin(0.10)


def test_better_values_differ_as_worse_ones_do():
    low, high = np.array([1.0, 1.01, 1.02, 1.03]), np.array([2.0, 2.01, 2.02, 2.03])
    expected = 2 / math.comb(8, 4)
    assert rank_equivalence(Sample(low, high), TEN).worse == pytest.approx(expected)
    assert rank_equivalence(Sample(high, low), TEN).worse == pytest.approx(expected)
    assert rank_equivalence(Sample(high, low), TEN).within == 1.0


def test_agreement_needs_both_tests():
    near = rank_equivalence(Sample(np.array([1.0, 1.01, 1.02, 1.03]), np.array([1.0, 1.005, 1.015, 1.025])), TEN)
    assert near.within == pytest.approx(1 / math.comb(8, 4))
    assert near.worse == 1.0


def test_equal_values_of_a_deterministic_system_agree():
    found = rank_equivalence(Sample(np.full(5, 0.05), np.full(5, 0.05)), TEN)
    assert found.within == pytest.approx(1 / math.comb(10, 5))


def test_one_recorded_value_is_a_claim_about_the_median():
    near, far = np.array([1.0, 1.02, 0.98, 1.05, 0.97]), np.array([1.2, 1.3, 1.25, 1.4, 1.22])
    assert rank_equivalence(Sample(np.array([1.0]), near), TEN).within == pytest.approx(1 / 32)
    assert rank_equivalence(Sample(np.array([1.0]), far), TEN).worse == pytest.approx(2 / 32)
    assert rank_equivalence(Sample(np.array([1.0]), np.append(far, 1.3)), TEN).worse == pytest.approx(2 / 64)
    lower = rank_equivalence(Sample(np.array([1.0]), far - 1.0), TEN)
    assert lower.worse == pytest.approx(2 / 32)
    assert lower.within == 1.0


def test_four_repeats_of_one_value_are_too_few():
    assert rank_equivalence(Sample(np.array([1.0]), np.full(4, 1.0)), TEN).within > SIGNIFICANCE
    nothing = rank_equivalence(Sample(np.array([1.0]), np.array([])), TEN)
    assert (nothing.worse, nothing.within) == (1.0, 1.0)


def test_failed_runs_count_in_both_directions():
    good, failed = np.full(5, 1.0), np.full(5, math.inf)
    for sample in (Sample(good, failed), Sample(failed, good)):
        assert rank_equivalence(sample, TEN).worse == pytest.approx(2 / math.comb(10, 5))
    assert failure_equivalence(FailureCounts(9, 10, 0, 10), Margin(0.0, relative=False)).worse < 0.001
    assert failure_equivalence(FailureCounts(1, 10, 0, 10), Margin(0.0, relative=False)).within == 1.0
    assert failure_equivalence(FailureCounts(0, 3, 0, 9), Margin(0.0, relative=False)).within == 0.0


def test_a_margin_of_zero_knows_failed_runs():
    """Zero times infinity is no number."""
    found = rank_evidence(Sample(np.array([1.0, 2.0, math.inf]), np.array([1.0, 2.0, 3.0])), Margin(0.0))
    assert 0 < found.worse <= 1


@pytest.mark.parametrize("recorded", [1, 8])
def test_false_answers_are_rare(recorded: int):
    """At the edge of the margin it may agree in 5 % of trials; without a change it may differ in 5 %."""
    trials, agreed, differed = 200, 0, 0
    draws = np.random.default_rng(recorded)
    for _ in range(trials):
        old = np.exp(draws.normal(0, 0.05, recorded)) if recorded > 1 else np.ones(1)
        edge = rank_equivalence(Sample(old, 1.1 * np.exp(draws.normal(0, 0.05, 8))), TEN)
        same = rank_equivalence(Sample(old, np.exp(draws.normal(0, 0.05, 8))), TEN)
        agreed += edge.within <= SIGNIFICANCE
        differed += same.worse <= SIGNIFICANCE
    most = stats.binom.ppf(0.999, trials, SIGNIFICANCE)
    assert agreed <= most
    assert differed <= most


def test_the_interval_of_a_median_needs_six_values():
    assert median_interval(np.arange(5.0)) is None
    assert median_interval(np.array([3.0, 1.0, 2.0, 6.0, 5.0, 4.0])) == Interval(1.0, 6.0)
    held = [median_interval(np.random.default_rng(seed).normal(0, 1, 12)) for seed in range(300)]
    inside = sum(entry is not None and entry.low <= 0 <= entry.high for entry in held)
    assert inside >= stats.binom.ppf(0.001, 300, 0.95)
