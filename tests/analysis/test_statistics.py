from __future__ import annotations

import numpy as np
import pytest
import scikit_posthocs
from scipy import stats

from slamhive.analysis.statistics import (
    bootstrap_mean,
    compare_means,
    holm,
    means_differ,
    rank_test,
    shares_p_value,
    summarise,
)
from slamhive.base.errors import InvalidInput

pytestmark = pytest.mark.integration  # scipy takes a second to load


def test_nemenyi_s_critical_difference():
    """Demsar (2006), section 3.2.2: four classifiers on fourteen datasets, q = 2.569, CD = 1.25."""
    result = rank_test(np.random.default_rng(2).random((14, 4)))
    assert result.critical_difference == pytest.approx(2.569 * np.sqrt(4 * 5 / (6 * 14)), abs=1e-3)


def test_ties_share_their_ranks():
    result = rank_test(np.array([[1.0, 2.0, 2.0], [3.0, 1.0, 2.0]]))
    assert result.mean_ranks.tolist() == [2.0, 1.75, 2.25]


def test_friedman_agrees_with_scipy():
    scores = np.random.default_rng(3).random((9, 5)).round(1)
    assert rank_test(scores).p_value == pytest.approx(stats.friedmanchisquare(*scores.T).pvalue)


@pytest.mark.parametrize(("seed", "blocks"), [(0, 9), (1, 9), (2, 9), (3, 9), (4, 12)])
def test_pairs_agree_with_scikit_posthocs(seed, blocks):
    """Its test of tied scores takes twice as long for each block more, up to a second for each pair."""
    draws = np.random.default_rng(seed)
    scores = draws.random((blocks, 4)).round(2) + np.array([0.0, 0.1, 0.2, 0.5])
    nemenyi = scikit_posthocs.posthoc_nemenyi_friedman(scores).to_numpy()
    holm = scikit_posthocs.posthoc_wilcoxon(scores.T.tolist(), p_adjust="holm").to_numpy()
    for test, expected in (("nemenyi", nemenyi), ("wilcoxon-holm", holm)):
        pairs = rank_test(scores, test).pairs
        assert len(pairs) == 6
        assert all(p_value == pytest.approx(expected[pair], rel=1e-6) for pair, p_value in pairs.items())


@pytest.mark.parametrize("blocks", [2, 3, 5, 8, 10, 14, 30])
@pytest.mark.parametrize("digits", [0, 1, 8])
def test_signed_ranks_agree_with_scipy(blocks, digits):
    """With many ties and zeros, with some, and without."""
    scores = np.random.default_rng(blocks).random((blocks, 3)).round(digits)
    found = rank_test(scores, "wilcoxon-holm").pairs
    apart = [scores[:, first] - scores[:, second] for first, second in found]
    assert list(found.values()) == pytest.approx(
        holm([stats.wilcoxon(entry).pvalue if entry.any() else 1.0 for entry in apart])
    )


def test_pairs_that_are_tied_everywhere_are_the_same():
    scores = np.array([[1.0, 1.0, 2.0], [3.0, 3.0, 1.0], [2.0, 2.0, 5.0]])
    assert rank_test(scores, "wilcoxon-holm").pairs[0, 1] == 1.0


def test_holm_s_correction_never_falls():
    scores = np.random.default_rng(1).random((20, 4)) + np.array([0, 0.0, 0.5, 1.0])
    result = rank_test(scores, "wilcoxon-holm")
    assert not result.same(0, 3)
    assert result.same(0, 1)
    assert result.critical_difference is None
    assert (0, 1) in [tuple(sorted(clique)) for clique in result.cliques()]


def test_equal_scores_are_all_one_clique():
    result = rank_test(np.ones((5, 3)))
    assert result.p_value == 1.0
    assert [sorted(clique) for clique in result.cliques()] == [[0, 1, 2]]


@pytest.mark.parametrize("shape", [(5, 2), (1, 4)])
def test_too_little_to_rank(shape):
    with pytest.raises(InvalidInput, match="Friedman"):
        rank_test(np.ones(shape))


def test_bootstrap_resamples_as_it_always_did():
    """Stored reports must not change when they are computed again: the same indices are drawn as in 0.1."""
    values = np.array([0.1, 0.4, 0.2, 0.9])
    means = values[np.random.default_rng(0).integers(0, 4, (2_000, 4))].mean(axis=1)
    interval = bootstrap_mean(values)
    assert (interval.low, interval.high) == pytest.approx(tuple(np.quantile(means, [0.025, 0.975])), rel=1e-12)


@pytest.mark.parametrize("count", [2, 7, 1500])
@pytest.mark.parametrize("weighted", [False, True])
def test_bootstrap_agrees_with_scipy(count, weighted):
    values, weights = np.random.default_rng(count).random((2, count))
    interval = bootstrap_mean(values, 3, weights if weighted else None)
    expected = stats.bootstrap(
        (values, weights) if weighted else (values,),
        (lambda v, w, axis: (v * w).sum(axis) / w.sum(axis)) if weighted else np.mean,
        paired=weighted,
        n_resamples=2_000,
        batch=1_000_000 // count,
        method="percentile",
        rng=np.random.default_rng(3),
    ).confidence_interval
    assert (interval.low, interval.high) == pytest.approx(tuple(expected), rel=1e-12)


def test_bootstrap_is_repeatable_and_covers():
    values = np.random.default_rng(0).normal(10, 2, 50)
    interval = bootstrap_mean(values)
    assert interval == bootstrap_mean(values)
    assert interval.low < values.mean() < interval.high
    assert interval.high - interval.low == pytest.approx(2 * 1.96 * values.std() / np.sqrt(50), rel=0.15)


def test_one_value_has_no_spread():
    summary = summarise(np.array([2.0, np.nan]))
    assert summary is not None
    assert (summary.count, summary.mean, summary.std, summary.interval) == (1, 2.0, None, None)
    assert summarise(np.array([np.nan])) is None


def test_repeats_that_would_decide():
    draws = np.random.default_rng(5)
    first, second = draws.normal(1.0, 0.3, 4), draws.normal(1.15, 0.3, 4)
    comparison = compare_means(first, second)
    assert not comparison.decided
    assert comparison.repeats_to_decide is not None
    assert comparison.repeats_to_decide > 4
    many = compare_means(np.tile(first, 200), np.tile(second, 200))
    assert many.decided
    assert many.difference == pytest.approx(comparison.difference)


def test_welch_agrees_with_scipy():
    draws = np.random.default_rng(7)
    first, second = draws.normal(0, 1, 12), draws.normal(0.5, 3, 7)
    test = stats.ttest_ind(first, second, equal_var=False)
    expected = test.confidence_interval(0.95)
    comparison = compare_means(first, second)
    found = comparison.interval
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))
    assert comparison.p_value == pytest.approx(test.pvalue)


@pytest.mark.parametrize(("first", "second"), [((0, 5), (2, 5)), ((3, 8), (0, 2)), ((4, 4), (0, 9)), ((0, 3), (0, 4))])
def test_fisher_agrees_with_scipy(first: tuple[int, int], second: tuple[int, int]) -> None:
    table = [[hits, total - hits] for hits, total in (first, second)]
    assert shares_p_value(first, second) == pytest.approx(stats.fisher_exact(table).pvalue)


def test_comparing_needs_repeats():
    with pytest.raises(InvalidInput, match="two runs of each, found 1 and 2"):
        compare_means(np.ones(1), np.ones(2))


def test_repeats_that_no_experiment_has_are_not_named():
    draws = np.random.default_rng(4)
    noise = draws.normal(0, 1, 4)
    result = compare_means(noise, noise[::-1] + 1e-5)
    assert not result.decided
    assert result.repeats_to_decide is None


def test_the_repeats_named_are_the_first_that_decide():
    """Two samples of unit variance whose means differ by 1: Welch's interval excludes 0 from n = 9 on."""
    first, second = np.array([-1.0, 1.0]) / np.sqrt(2), np.array([-1.0, 1.0]) / np.sqrt(2) + 1.0
    needed = compare_means(first, second).repeats_to_decide
    reaches = {n: stats.t.ppf(0.975, 2 * n - 2) * np.sqrt(2 / n) for n in range(2, 30)}
    assert needed == min(n for n, reach in reaches.items() if reach < 1)


def test_moments_decide_as_the_values_do() -> None:
    random = np.random.default_rng(5)
    decisions = []
    for distance in np.linspace(0, 4, 40):
        first, second = random.normal(0, 1, 6), random.normal(distance, 2, 9)
        moments = [(len(values), float(values.mean()), float(values.var(ddof=1))) for values in (first, second)]
        decided = means_differ(moments[0], moments[1])
        assert decided == compare_means(first, second).decided
        decisions.append(decided)
    assert set(decisions) == {True, False}
