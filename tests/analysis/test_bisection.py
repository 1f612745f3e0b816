"""Searches for the first bad commit and the shortest clip: how seldom they err, and what they do about gaps."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np
import pytest

from slamhive.analysis.bisection import (
    Clip,
    History,
    HistoryState,
    next_runs,
    search_clips,
    search_history,
    step_error,
    step_verdict,
)
from slamhive.domain.gate import Margin, TrialStanding

pytestmark = pytest.mark.integration  # scipy takes a second to load

ALLOWED = Margin(0.05)
COMMITS = [f"c{number}" for number in range(1, 26)]
LINE = History({name: (f"c{number}",) for number, name in enumerate(COMMITS)}, "c25")
EXPECTED = math.ceil(math.log2(25)) + 1


def found(first_bad: int, skipped: Collection[str] = ()) -> HistoryState:
    def standing(commit: str) -> TrialStanding:
        if commit in skipped:
            return TrialStanding.SKIPPED
        return TrialStanding.BAD if int(commit[1:]) >= first_bad else TrialStanding.GOOD

    return search_history(LINE, standing)


@pytest.mark.parametrize("first_bad", range(1, 26))
def test_each_first_bad_commit_of_a_line_is_found_by_halving(first_bad: int):
    state = found(first_bad)
    assert state.left == (f"c{first_bad}",)
    assert len(state.tried) <= 5


@pytest.mark.parametrize("first_bad", range(1, 26))
def test_two_commits_that_cannot_be_tried_cost_no_more_than_twice_the_halving(first_bad: int):
    skipped = {"c13", "c7"} - {f"c{first_bad}", f"c{first_bad - 1}"}
    state = found(first_bad, skipped)
    assert state.left == (f"c{first_bad}",)
    assert sum(standing is not TrialStanding.SKIPPED for _, standing in state.tried) <= 2 * math.log2(25)


def test_a_first_bad_commit_behind_skipped_ones_is_one_of_several():
    assert found(13, {"c12", "c11"}).left == ("c11", "c12", "c13")


def test_a_commit_that_nobody_has_tried_is_asked_for():
    state = search_history(LINE, lambda _commit: None)
    assert (state.ask, state.tried, len(state.left)) == ("c12", (), 25)


def test_a_branch_that_was_merged_is_searched_too():
    history = History({"a": ("0",), "x": ("0",), "y": ("x",), "m": ("a", "y"), "z": ("m",)}, "z")
    bad = {"y", "m", "z"}
    state = search_history(history, lambda commit: TrialStanding.BAD if commit in bad else TrialStanding.GOOD)
    assert state.left == ("y",)


def noisy(rng: np.random.Generator, factor: float) -> np.ndarray:
    """Errors of 60 runs that vary by 3 %."""
    return 0.05 * factor * np.exp(rng.normal(0, 0.03, 60))


@pytest.mark.parametrize("factor", [1.10, 4.0])
def test_of_two_hundred_noisy_searches_hardly_any_finds_another_commit(factor: float):
    right = 0
    runs: list[int] = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        first_bad = int(rng.integers(1, 26))
        skipped = set(rng.choice(COMMITS[:-1], 2, replace=False)) - {f"c{first_bad}", f"c{first_bad - 1}"}
        reference = noisy(rng, 1.0)
        errors = iter(step_error(0.05, step, EXPECTED) for step in range(99))

        def standing(commit: str) -> TrialStanding:
            if commit in skipped:  # noqa: B023 - used up within the turn
                return TrialStanding.SKIPPED
            is_bad = int(commit[1:]) >= first_bad  # noqa: B023 - as above
            values = noisy(rng, factor if is_bad else 1.0)  # noqa: B023 - as above
            verdict = step_verdict([reference], [values], ALLOWED, next(errors))  # noqa: B023 - as above
            runs.append(verdict.runs)
            return verdict.standing or TrialStanding.SKIPPED

        right += search_history(LINE, standing).left == (f"c{first_bad}",)
    assert right >= 190
    assert np.mean(runs) < 20


def test_the_chances_of_all_steps_together_stay_below_that_of_the_search():
    assert sum(step_error(0.05, step, EXPECTED) for step in range(10_000)) <= 0.05


def test_runs_that_do_not_vary_decide_as_soon_as_any_could():
    few = next_runs(2, 1, 0.005)
    verdict = step_verdict([np.full(few, 0.05)], [np.full(few, 0.06)], ALLOWED, 0.005)
    assert (verdict.standing, verdict.runs) == (TrialStanding.BAD, few)
    assert verdict.e_value is not None
    assert verdict.e_value > 1 / 0.005


def test_a_failed_run_counts_as_bad_and_a_share_of_failures_can_be_compared():
    failing = np.array([0.05, math.inf] * 20)
    assert step_verdict([np.full(40, 0.05)], [failing], ALLOWED, 0.005).standing is TrialStanding.BAD
    shares = [np.zeros(40)], [np.array([0.0, 1.0] * 20)]
    assert step_verdict(*shares, Margin(0.1, relative=False), 0.005).standing is TrialStanding.BAD


def test_where_more_is_better_less_is_worse():
    tracked, lost, better = np.full(12, -0.98), np.full(12, -0.80), np.full(12, -0.981)
    verdicts = [step_verdict([tracked], [values], ALLOWED, 0.005) for values in (lost, better)]
    assert [verdict.standing for verdict in verdicts] == [TrialStanding.BAD, TrialStanding.GOOD]


@pytest.mark.parametrize(("begin_s", "end_s"), [(0.0, 2.0), (41.3, 44.9), (95.0, 100.0), (0.0, 100.0)])
def test_the_shortest_clip_around_a_fault_is_found(begin_s: float, end_s: float):
    def standing(clip: Clip) -> TrialStanding:
        return TrialStanding.BAD if clip[0] <= begin_s and clip[1] >= end_s else TrialStanding.GOOD

    state = search_clips(100.0, 1.0, standing)
    assert state.best == (float(math.floor(begin_s)), float(math.ceil(end_s)))
    assert len(state.tried) <= 2 * math.ceil(math.log2(100))
