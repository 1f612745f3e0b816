"""Tests against a baseline: known p values, false alarms that are bounded, and power."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from slamhive.analysis.regression import (
    Evidence,
    FailureCounts,
    Sample,
    decide,
    failure_evidence,
    over_configurations,
    rank_evidence,
    typical_change,
)
from slamhive.analysis.statistics import Numbers
from slamhive.domain.gate import SIGNIFICANCE, Answer, Margin
from slamhive.domain.question import RunBudget
from slamhive.services.gates import Repeats

pytestmark = pytest.mark.integration  # scipy takes a second to load

EXACT = Margin(0.0)
FIVE = Margin(0.05)


def draws(seed: int, count: int, spread: float, median: float = 1.0) -> Numbers:
    """Values as errors of runs have them: log-normal, so that ``spread`` is about their relative deviation."""
    return median * np.exp(np.random.default_rng(seed).normal(0.0, spread, count))


def evidence(seed: int, counts: tuple[int, int], spread: float, change: float, margin: Margin) -> Evidence:
    baseline, candidate = draws(2 * seed, counts[0], spread), draws(2 * seed + 1, counts[1], spread, 1 + change)
    return rank_evidence(Sample(baseline, candidate), margin)


def most_by_chance(trials: int, share: float) -> int:
    """More of ``trials`` than this happen in one of a thousand test runs, if each has the probability ``share``."""
    return int(stats.binom.ppf(0.999, trials, share))


def test_separated_groups_have_the_smallest_p_value_that_is_possible():
    found = rank_evidence(Sample(np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0, 7.0])), EXACT)
    assert found.worse == pytest.approx(1 / math.comb(7, 3))
    assert found.within == 1.0


def test_equal_values_within_groups_are_no_stronger_evidence():
    """The normal approximation would give 0.02 for three equal values against three others."""
    found = rank_evidence(Sample(np.full(3, 1.0), np.full(3, 2.0)), EXACT)
    assert found.worse == pytest.approx(1 / math.comb(6, 3))


def test_the_p_value_with_ties_is_that_of_all_arrangements():
    baseline, candidate = np.array([1.0, 2.0, 2.0, 3.0]), np.array([2.0, 3.0, 3.0, 4.0, 4.0])
    found = rank_evidence(Sample(baseline, candidate), EXACT).worse
    method = stats.PermutationMethod(n_resamples=10_000)
    expected = stats.mannwhitneyu(candidate, baseline, alternative="greater", method=method).pvalue
    assert found == pytest.approx(expected)


def test_the_margin_is_a_share_or_an_amount():
    baseline, candidate = np.full(4, 2.0), np.full(4, 2.3)
    assert rank_evidence(Sample(baseline, candidate), Margin(0.2)).within == pytest.approx(1 / math.comb(8, 4))
    assert rank_evidence(Sample(baseline, candidate), Margin(0.2, relative=False)).worse < 0.05
    # Where more is better, values come in with the opposite sign: 0.95 of 0.99 is within a margin of 5 %.
    assert rank_evidence(Sample(np.full(4, -0.99), np.full(4, -0.95)), FIVE).within < 0.05
    assert rank_evidence(Sample(np.full(4, -0.99), np.full(4, -0.90)), FIVE).worse < 0.05


def test_a_failed_run_ranks_behind_every_other():
    baseline = np.array([0.10, 0.11, 0.12, 0.13, 0.14])
    one = np.array([0.10, 0.11, 0.12, 0.13, math.inf])
    assert rank_evidence(Sample(baseline, one), FIVE).within > rank_evidence(Sample(baseline, baseline), FIVE).within
    all_failed = np.full(5, math.inf)
    assert rank_evidence(Sample(baseline, all_failed), FIVE).worse == pytest.approx(1 / math.comb(10, 5))
    assert rank_evidence(Sample(all_failed, all_failed), FIVE) == Evidence(1.0, 1.0)


@pytest.mark.parametrize("candidate", [np.array([]), np.array([9.0])])
def test_less_than_two_values_are_no_evidence(candidate: Numbers):
    assert rank_evidence(Sample(np.ones(30), candidate), FIVE) == Evidence(1.0, 1.0)


def test_failures_are_compared_by_fisher_s_test():
    found = failure_evidence(FailureCounts(0, 10, 5, 10), EXACT)
    assert found.worse == pytest.approx(math.comb(10, 5) / math.comb(20, 5))
    assert found.within == 1.0
    assert failure_evidence(FailureCounts(1, 10, 2, 20), EXACT) == Evidence(1.0, 0.0)
    assert failure_evidence(FailureCounts(0, 10, 1, 20), Margin(0.05, relative=False)) == Evidence(1.0, 0.0)


def test_one_configuration_that_is_clearly_worse_is_not_outvoted():
    clearly = rank_evidence(Sample(np.arange(1.0, 9.0), np.arange(11.0, 19.0)), FIVE)
    same = Evidence(1.0, 0.001)
    found = over_configurations([clearly, *[same] * 10], [1.0] * 11)
    assert found.worse < 0.01
    assert found.within == 1.0


def test_many_configurations_that_are_a_little_worse_are_found_together():
    found = over_configurations([Evidence(0.1, 0.9)] * 11, [1.0] * 11)
    assert found.worse < 0.02 < min(1.0, 11 * 0.1)


@pytest.mark.parametrize(("configurations", "trials"), [(1, 120), (3, 50)])
def test_false_alarms_stay_below_the_significance_over_all_metrics(configurations: int, trials: int):
    """Nothing has changed, and the margin is 0: the hardest case."""
    metrics, alarms = 4, 0
    for trial in range(trials):
        found = {}
        for metric in range(metrics):
            seeds = [(trial * metrics + metric) * configurations + place for place in range(configurations)]
            parts = [evidence(seed, (8, 8), 0.3, 0.0, EXACT) for seed in seeds]
            found[str(metric)] = over_configurations(parts, [1.0] * configurations)
        alarms += any(answer is Answer.WORSE for answer, _ in decide(found, SIGNIFICANCE).values())
    assert alarms <= most_by_chance(trials, SIGNIFICANCE)


def test_false_alarms_stay_below_the_significance_over_all_looks():
    trials, alarms = 250, 0
    repeats = Repeats(5, RunBudget(runs=20))
    for trial in range(trials):
        baseline, candidate = draws(2 * trial, 10, 0.3), draws(2 * trial + 1, 20, 0.3)
        for look, count in enumerate((5, 10, 20), start=1):
            found = {"ate.rmse": rank_evidence(Sample(baseline, candidate[:count]), EXACT)}
            if decide(found, repeats.significance(look))["ate.rmse"][0] is Answer.WORSE:
                alarms += 1
                break
    assert alarms <= most_by_chance(trials, SIGNIFICANCE)


def test_a_change_of_the_size_of_the_margin_rarely_passes():
    trials = 250
    passed = sum(evidence(seed, (8, 8), 0.1, FIVE.value, FIVE).within <= SIGNIFICANCE for seed in range(trials))
    assert passed <= most_by_chance(trials, SIGNIFICANCE)


def test_a_change_of_20_percent_is_found_at_10_repeats():
    """One of six metrics became worse by 20 %; its values vary by 5 %."""
    trials, found = 100, 0
    for seed in range(trials):
        tests = {"ate.rmse": evidence(seed, (10, 10), 0.05, 0.2, FIVE)}
        tests |= {f"other{place}": Evidence(0.5, 0.001) for place in range(5)}
        found += decide(tests, SIGNIFICANCE)["ate.rmse"][0] is Answer.WORSE
    assert found >= 95


def test_what_did_not_change_passes_at_10_repeats():
    """Values that vary by 2 %, and a margin of 5 %."""
    found = [decide({"": evidence(seed, (10, 10), 0.02, 0.0, FIVE)}, SIGNIFICANCE)[""][0] for seed in range(100)]
    assert found.count(Answer.PASS) >= 95
    assert Answer.WORSE not in found


def test_the_correction_is_holm_s():
    tests = {"a": Evidence(0.012, 1.0), "b": Evidence(0.02, 1.0), "c": Evidence(0.5, 0.04)}
    found = decide(tests, 0.05)
    assert [found[key][0] for key in "abc"] == [Answer.WORSE, Answer.WORSE, Answer.PASS]
    assert [found[key][1] for key in "abc"] == pytest.approx([0.036, 0.04, 0.5])


def test_the_change_is_that_of_medians_over_configurations():
    baseline, candidate = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 6.0])
    found = typical_change([(baseline, candidate), (baseline, baseline)], relative=True)
    assert found is not None
    assert found.value == pytest.approx(math.sqrt(2) - 1)
    assert found.interval is not None
    assert found.interval.low <= found.value <= found.interval.high
    amount = typical_change([(baseline, candidate), (baseline, baseline)], relative=False)
    assert amount is not None
    assert amount.value == pytest.approx(1.0)


def test_the_interval_of_the_change_covers_it():
    covered = 0
    for seed in range(60):
        found = typical_change([(draws(2 * seed, 15, 0.1), draws(2 * seed + 1, 15, 0.1, 1.2))], relative=True)
        assert found is not None
        assert found.interval is not None
        covered += found.interval.low <= 0.2 <= found.interval.high
    assert covered >= 60 - most_by_chance(60, 0.05)


@pytest.mark.parametrize(
    ("pairs", "relative"),
    [([], True), ([(np.array([]), np.ones(3))], True), ([(np.zeros(3), np.ones(3))], True)],
)
def test_a_change_that_does_not_exist_is_none(pairs: list[tuple[Numbers, Numbers]], relative: bool):
    assert typical_change(pairs, relative=relative) is None


def test_single_values_have_no_interval():
    found = typical_change([(np.ones(1), np.full(1, 1.5))], relative=True)
    assert found is not None
    assert found.value == pytest.approx(0.5)
    assert found.interval is None
