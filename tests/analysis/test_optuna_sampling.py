"""The next runs of a search as Optuna chooses them."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest

from slamhive.analysis import optuna_sampling
from slamhive.analysis.adaptive_search import SearchSpace, first_places
from slamhive.analysis.optuna_sampling import check_sampler, suggested
from slamhive.base.errors import Unavailable
from slamhive.domain.question import SearchSampler

pytestmark = pytest.mark.integration  # optuna takes half a second to load

GRID = np.array(list(product(range(2), range(6), range(6))), dtype=float)
SPACE = SearchSpace(GRID / np.array([1, 5, 5]), (False, True, True))
SCORES = 0.1 * (GRID[:, 1] - 2) ** 2 + 0.05 * (GRID[:, 2] - 3) ** 2 + 0.3 * GRID[:, 0]
NONE = np.array([], dtype=np.intp)


@pytest.mark.parametrize("sampler", [SearchSampler.TPE, SearchSampler.NSGA2])
def test_runs_gather_where_scores_are_small(sampler: SearchSampler):
    places = [int(place) for place in first_places(len(GRID), 0)[:24]]
    while len(places) < 96:
        done = np.array(places)
        places += suggested(sampler, SPACE, done, SCORES[done][:, None], 8, NONE)
    assert SCORES[places[48:]].mean() < SCORES[places[:24]].mean() / 1.5


def test_the_same_runs_lead_to_the_same_next_ones_and_runs_under_way_to_others():
    done = np.arange(40)
    first, second, third = (
        suggested(SearchSampler.TPE, SPACE, done, SCORES[done][:, None], 4, np.array(pending, dtype=np.intp))
        for pending in ([], [], [3, 4])
    )
    assert first == second != third


def test_a_suggestion_that_is_no_candidate_becomes_the_nearest():
    kept = GRID[:, 1] + GRID[:, 2] < 4
    codes = SPACE.codes[kept].copy()
    codes[0, 1] = math.nan
    space = SearchSpace(codes, SPACE.ordered)
    done = np.arange(20)
    chosen = suggested(SearchSampler.NSGA2, space, done, np.column_stack([SCORES[done], -SCORES[done]]), 12, NONE)
    assert all(0 <= place < kept.sum() for place in chosen)


def test_without_optuna_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(optuna_sampling, "find_spec", lambda _name: None)
    check_sampler(SearchSampler.MODEL)
    with pytest.raises(Unavailable, match=r"needs Optuna, which is not installed.*slamhive\[optimise\]"):
        check_sampler(SearchSampler.TPE)
