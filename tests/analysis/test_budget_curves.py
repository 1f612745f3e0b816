"""Budget curves: the smallest budget that is enough, how certain that is, and the sentence about it."""

from __future__ import annotations

import numpy as np
import pytest

from slamhive.analysis.analysis_file import parse_analysis
from slamhive.analysis.chart import Line
from slamhive.analysis.plot_types.budget import BudgetOptions, find_knee
from slamhive.analysis.report import PlotResult
from slamhive.analysis.table import make_table
from slamhive.base.errors import InvalidInput
from tests.analysis.analysis_world import data_of

CORES = (0.25, 0.5, 1.0, 2.0)


def scores(*means, runs=8, noise=0.02, failed=(0, 0, 0, 0)):
    draws = np.random.default_rng(1)
    found = [mean * (1 + noise * draws.standard_normal(runs)) for mean in means]
    for values, count in zip(found, failed, strict=True):
        values[:count] = np.inf
    return found


def test_the_knee_is_the_smallest_budget_near_the_best():
    knee = find_knee(CORES, scores(0.3, 0.105, 0.1, 0.1), BudgetOptions(margin=0.1))
    assert knee.value == 0.5
    assert knee.certainty is not None
    assert knee.certainty > 0.95
    strict = find_knee(CORES, scores(0.3, 0.15, 0.1, 0.1), BudgetOptions(margin=0.1))
    assert strict.value == 1.0


def test_a_budget_whose_runs_fail_more_often_is_not_enough():
    means = (0.1, 0.1, 0.1, 0.1)
    knee = find_knee(CORES, scores(*means, failed=(6, 2, 0, 0)), BudgetOptions(margin=0.1))
    assert knee.value == 1.0
    loose = find_knee(CORES, scores(*means, failed=(6, 2, 0, 0)), BudgetOptions(margin=0.1, failing=0.3))
    assert loose.value == 0.5
    # A budget of which nothing is left is no candidate, whatever its share may be.
    gone = find_knee(CORES, scores(*means, failed=(8, 8, 8, 8)), BudgetOptions(failing=1.0))
    assert gone.value is None


def test_noise_makes_the_knee_uncertain_and_single_runs_leave_it_unknown():
    unsure = find_knee(CORES, scores(0.3, 0.11, 0.1, 0.1, runs=4, noise=0.15), BudgetOptions(margin=0.1))
    assert unsure.interval is not None
    assert unsure.certainty is not None
    assert unsure.interval.low < unsure.interval.high
    assert unsure.certainty < 0.95
    alone = find_knee(CORES, scores(0.3, 0.11, 0.1, 0.1, runs=1, noise=0.0), BudgetOptions(margin=0.2))
    assert (alone.value, alone.interval, alone.certainty) == (0.5, None, None)


def test_the_interval_holds_the_true_knee():
    """Five runs are few for a bootstrap, so 90 % are asked for."""
    rule, held = BudgetOptions(margin=0.25), 0
    for seed in range(200):
        draws = np.random.default_rng(seed)
        values = [mean * (1 + 0.1 * draws.standard_normal(5)) for mean in (0.4, 0.13, 0.115, 0.1)]
        interval = find_knee(CORES, values, rule).interval
        assert interval is not None
        held += interval.low <= 1.0 <= interval.high
    assert held >= 180


def boards(memory_fails: bool = False, options: str = "at_most: 0.1") -> PlotResult:
    rows = [(cores, memory, repeat) for cores in CORES for memory in (300, 600) for repeat in range(5)]
    bad = [cores < 0.5 or (memory < 600 and memory_fails) for cores, memory, _ in rows]
    count = len(rows)
    table = make_table(
        {
            "run_id": list(range(1, count + 1)),
            "configuration_id": [1] * count,
            "algorithm": ["kiss-icp"] * count,
            "dataset": ["room"] * count,
            "state": ["failed" if failed else "succeeded" for failed in bad],
            "reason": ["timeout" if failed else None for failed in bad],
            "protocol": [None if failed else "aaaaaaaaaaaa" for failed in bad],
            "protocol_label": [None if failed else "SE(3)" for failed in bad],
            "cpu_cores": [cores for cores, _, _ in rows],
            "memory_mb": [memory for _, memory, _ in rows],
            "slow_down": [1.0] * count,
        },
        {},
        {
            "ate.rmse": [
                None if failed else 0.05 + 0.001 * repeat for failed, (_, _, repeat) in zip(bad, rows, strict=True)
            ],
            "tracked_fraction": [None if failed else 1.0 for failed in bad],
            "frames.dropped_fraction": [0.4 if cores < 0.5 else 0.0 for cores, _, _ in rows],
        },
    )
    (request,) = parse_analysis(f"name: t\nselect: {{a: {{runs: [1]}}}}\nforms:\n- {{form: budget, {options}}}\n").plots
    return request.plot_type.build(data_of(table), request.options)


def test_the_sentence_says_what_is_needed_here():
    result = boards()
    assert result.notes == (
        "kiss-icp on room needs 0.5 cores (95 %: no other) and 300 MB (95 %: no other) for ATE RMSE <= 0.1 m here.",
    )
    assert [chart.key for chart in result.charts] == [
        "budget_cpu_cores_ate.rmse",
        "budget_cpu_cores_failures",
        "budget_memory_mb_ate.rmse",
        "budget_memory_mb_failures",
    ]


def test_failed_runs_are_shown_as_failures_with_their_dropped_frames():
    failures = boards().charts[1]
    failed, dropped = (mark for mark in failures.marks if isinstance(mark, Line) and len(mark.x) == len(CORES))
    assert list(failed.y) == [100.0, 0.0, 0.0, 0.0]
    assert list(dropped.y) == [40.0, 0.0, 0.0, 0.0]
    assert "10 failed" in failures.caption
    assert "Several limits together: CPU limit 0.25, 0.5, 1, 2 cores; Memory limit 300, 600 MB." in failures.caption


def test_a_budget_that_is_too_small_everywhere_is_told():
    (sentence,) = boards(options="at_most: 0.01").notes
    assert (
        sentence
        == "kiss-icp on room: no CPU limit and no Memory limit that was tried is enough for ATE RMSE <= 0.01 m here."
    )
    with pytest.raises(InvalidInput, match="'slow_down' has one value"):
        boards(options="budgets: [slow_down]")


def test_memory_that_makes_runs_fail_is_not_enough():
    assert "0.5 cores (95 %: no other) and 600 MB" in boards(memory_fails=True).notes[0]
