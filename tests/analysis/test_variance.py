"""The analysis of variance finds what was put in, and nothing else."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from slamhive.analysis.statistics import Effects, explain_variance

pytestmark = pytest.mark.integration  # scipy takes a second to load


def explain(rows, quantity, *, noise: float = 0.0) -> Effects:
    """The effects of ``quantity(*row)`` over ``rows``; factors are called a, b, c ..."""
    draws = np.random.default_rng(3)
    codes = {name: np.unique(levels, return_inverse=True)[1] for name, *levels in zip("abcdef", *rows, strict=False)}
    values = np.array([quantity(*row) for row in rows], dtype=float)
    return explain_variance(codes, values + noise * draws.normal(size=len(rows)))


TWO_BY_TWO = list(product((0, 1), (0, 1)))


@pytest.mark.parametrize("repeats", [1, 3])
def test_a_design_without_interaction_has_none(repeats):
    found = explain(TWO_BY_TWO * repeats, lambda a, b: a + b)
    assert found.main == {"a": pytest.approx(0.5), "b": pytest.approx(0.5)}
    assert found.pairs == {("a", "b"): 0.0}
    assert found.shared == 0.0


def test_a_pure_interaction_has_no_main_effects():
    found = explain(TWO_BY_TWO * 10, lambda a, b: a ^ b, noise=0.01)
    assert found.pairs["a", "b"] == pytest.approx(1.0, abs=1e-3)
    assert max(share or 0.0 for share in found.main.values()) < 1e-3


def test_shares_of_a_balanced_design_are_those_of_the_textbook():
    """Omega squared by the sums of squares of a balanced two-way layout, computed from cell means."""
    rows = [row for row in product(range(3), range(4)) for _ in range(5)]
    draws = np.random.default_rng(5)
    values = np.array([a + 0.3 * b + 0.5 * (a == b) for a, b in rows]) + 0.4 * draws.normal(size=len(rows))
    found = explain_variance({"a": np.array([a for a, _ in rows]), "b": np.array([b for _, b in rows])}, values)
    cells = values.reshape(3, 4, 5)
    grand, of_a, of_b, of_cells = cells.mean(), cells.mean(axis=(1, 2)), cells.mean(axis=(0, 2)), cells.mean(axis=2)
    both = of_cells - of_a[:, None] - of_b + grand
    squares = {"a": 20 * ((of_a - grand) ** 2).sum(), "b": 15 * ((of_b - grand) ** 2).sum(), "ab": 5 * (both**2).sum()}
    noise = ((cells - of_cells[:, :, None]) ** 2).sum() / (60 - 12)
    total = ((values - grand) ** 2).sum()
    expected = {
        key: (squares[key] - freedom * noise) / (total + noise) for key, freedom in (("a", 2), ("b", 3), ("ab", 6))
    }
    assert found.main == {"a": pytest.approx(expected["a"]), "b": pytest.approx(expected["b"])}
    assert found.pairs["a", "b"] == pytest.approx(expected["ab"])


def test_an_unbalanced_design_invents_no_interaction_and_says_what_is_shared():
    rows = [(0, 0)] * 20 + [(0, 1)] * 4 + [(1, 0)] * 3 + [(1, 1)] * 20
    found = explain(rows, lambda a, b: a + b, noise=0.01)
    assert found.pairs["a", "b"] == pytest.approx(0.0, abs=1e-3)
    assert found.main["a"] == pytest.approx(found.main["b"] or 0.0, abs=0.03)
    assert found.shared > 0.5
    assert sum(share or 0.0 for share in found.main.values()) + found.shared == pytest.approx(1.0, abs=1e-3)


def test_without_repeats_a_pair_cannot_be_told_from_chance():
    found = explain(TWO_BY_TWO, lambda a, b: a + b, noise=0.1)
    assert found.pairs == {("a", "b"): None}
    assert found.left_out == 1
    assert all(share is not None for share in found.main.values())


def test_empty_cells_are_no_trouble():
    rows = [row for row in product(range(3), range(3), range(2)) if row[:2] != (0, 2)] * 3
    found = explain(rows, lambda a, b, c: 2 * a + b * c, noise=0.01)
    assert found.pairs["a", "b"] == pytest.approx(0.0, abs=1e-3)
    assert found.pairs["b", "c"] is not None
    assert found.pairs["b", "c"] > 0.02


def test_factors_that_vary_together_have_the_share_of_both():
    found = explain([(level, level, other) for level, other in product(range(3), range(2))] * 2, lambda a, _, c: a + c)
    assert found.aliases == (("a", "b"),)
    assert found.main["a"] == found.main["b"]
    assert ("a", "b") not in found.pairs


def test_a_factor_within_another_is_adjusted_for_it():
    """``b`` has other levels for each level of ``a``: what ``a`` explains is not taken away from it."""
    rows = [(a, 10 * a + b) for a, b in product(range(2), range(3))] * 4
    found = explain(rows, lambda a, b: 10 * a + b % 10)
    assert found.main["a"] == pytest.approx(25 / (25 + 2 / 3))
    assert found.main["b"] == pytest.approx((2 / 3) / (25 + 2 / 3))


def test_nothing_varies():
    found = explain(TWO_BY_TWO, lambda *_: 1.0)
    assert found.main == {"a": 0.0, "b": 0.0}


def test_a_hundred_thousand_runs_of_many_parameters_take_seconds():
    draws = np.random.default_rng(1)
    codes = {f"p{place}": draws.integers(0, 12, 100_000) for place in range(20)}
    found = explain_variance(codes, codes["p0"] + draws.normal(size=100_000))
    assert found.main["p0"] == pytest.approx(11.9 / 12.9, abs=0.01)
    assert found.left_out == 188
