"""Analyses judge runs by the rule that holds everywhere, unless their file sets another."""

from __future__ import annotations

import pytest

from slamhive.analysis.analysis_file import parse_analysis
from slamhive.analysis.table import FAILED, RunTable, make_table
from slamhive.domain.verdict import DEFAULT_RULE, FailureRule

pytestmark = pytest.mark.quick

TEXT = "name: a\nselect: {all: {where: 'id >= 1'}}\nforms:\n- {form: coverage}\n"


BY_TIME = FailureRule(tracked_path_below=None, tracked_fraction_below=0.1)


def table(metrics: dict[str, list[float | None]]) -> RunTable:
    """Runs of one system that ended well."""
    count = len(next(iter(metrics.values())))
    facts: dict[str, list[object]] = {
        "run_id": list(range(1, count + 1)),
        "configuration_id": [1] * count,
        "algorithm": ["orb"] * count,
        "dataset": ["room"] * count,
        "state": ["succeeded"] * count,
        "evaluation": ["succeeded"] * count,
    }
    return make_table(facts, {}, metrics)


def test_keyframe_runs_are_good_and_diverged_ones_have_failed() -> None:
    found = table(
        {
            "ate.rmse": [0.1, 0.1, 1.4, 6.0, None],
            "tracked_fraction": [0.2, 0.9, 0.9, 0.9, None],
            "tracked.path": [0.95, 0.5, 0.9, 0.9, None],
            "ate.per_path": [0.1, 0.1, 1.5, 7.0, None],
            "ate.over_repeats": [1.0, 1.0, 14.0, 60.0, None],
            "ate.repeats_limit": [4.0, 4.0, 4.0, 4.0, None],
        }
    )
    assert list(found.frame[FAILED]) == [
        None,
        "tracked too little",
        "diverged (outlier among its repeats)",
        "diverged",
        None,
    ]
    assert found.rule_words == DEFAULT_RULE.words


def test_runs_from_before_the_rule_are_judged_by_what_they_have_and_the_caption_says_so() -> None:
    found = table({"ate.rmse": [0.1, 0.1], "tracked_fraction": [0.2, 0.9], "tracked.path": [None, None]})
    assert list(found.frame[FAILED]) == ["tracked too little", None]
    assert "2 of the runs have old evaluations" in found.rule_words
    assert "Evaluate them again" in found.rule_words


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("", DEFAULT_RULE),
        (
            "failed_when: {tracked_fraction_below: 0.1}\n",
            FailureRule(tracked_path_below=None, tracked_fraction_below=0.1),
        ),
        ("failed_when: {tracked_fraction_below: null}\n", FailureRule(tracked_path_below=None)),
        ("failed_when: {ate_rmse_above_m: 0.5}\n", FailureRule(ate_rmse_above_m=0.5)),
        (
            "failed_when: {tracked_path_below: 0.9, tracked_fraction_below: 0.8, outliers: false}\n",
            FailureRule(0.9, 0.8, outliers=False),
        ),
    ],
)
def test_a_file_may_set_another_rule_and_older_files_mean_what_they_meant(text: str, rule: FailureRule) -> None:
    assert parse_analysis(TEXT + text).rule == rule
