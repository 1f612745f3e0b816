from __future__ import annotations

import pytest

from slamhive.documents.limits import NEVER, StopWhen
from slamhive.domain.run import FailureReason
from slamhive.run_folder.outcome import (
    UNSEEN,
    EarlyEnd,
    Evidence,
    Observation,
    TrajectoryCheck,
    broken_rule,
    decide,
    skipped,
)

ALL = StopWhen(lost_tracking_s=5, memory_mb=100, time_s=60)
VALID = TrajectoryCheck(poses=7)


@pytest.mark.parametrize(
    ("seen", "reason", "words"),
    [
        (Observation(60.0, 100_000_000, 5.0), None, ""),
        (Observation(1.0), None, ""),
        (Observation(60.5), FailureReason.TIME_BUDGET, "ran for 60.5 s, stop_when allows time_s 60"),
        (Observation(1.0, 100_500_000), FailureReason.MEMORY_BUDGET, "used 100.5 MB, stop_when allows memory_mb 100"),
        (
            Observation(1.0, None, 5.25),
            FailureReason.LOST_TRACKING,
            "no pose for 5.2 s of the recording, stop_when allows lost_tracking_s 5",
        ),
        (Observation(61.0, 200_000_000, 9.0), FailureReason.TIME_BUDGET, "time_s"),
        (Observation(1.0, 200_000_000, 9.0), FailureReason.MEMORY_BUDGET, "memory_mb"),
    ],
)
def test_the_first_broken_rule_ends_a_run_and_names_the_figure(seen, reason, words):
    broken = broken_rule(ALL, seen)
    assert (None if broken is None else broken.reason) is reason
    assert words in ("" if broken is None else broken.detail)


def test_without_rules_nothing_ends_a_run():
    assert broken_rule(NEVER, Observation(1e9, 10**15, 1e9)) is None
    assert skipped(NEVER, 1000) is None


@pytest.mark.parametrize(("failures", "tried"), [(0, True), (1, True), (2, False), (3, False)])
def test_a_configuration_that_failed_often_enough_is_not_tried_again(failures, tried):
    found = skipped(StopWhen(failures_of_configuration=2), failures)
    assert (found is None) is tried
    if found is not None:
        assert found.reason is FailureReason.CONFIGURATION_FAILED
        assert f"failed {failures} times, stop_when allows failures_of_configuration 2" in found.detail


def test_an_early_end_comes_after_the_limits_and_before_what_the_stop_has_left():
    early = EarlyEnd(FailureReason.LOST_TRACKING, "ended early: no pose")
    outcome = decide(Evidence(143, VALID, ended_early=early))
    assert (outcome.reason, outcome.detail, outcome.poses) == (early.reason, early.detail, 7)
    assert decide(Evidence(0, VALID, ended_early=early, finished=True)).reason is early.reason
    assert decide(Evidence(None, VALID, ended_early=early, gone_because="removed")).reason is early.reason
    assert decide(Evidence(137, VALID, ended_early=early, out_of_memory=True)).reason is FailureReason.OUT_OF_MEMORY
    assert decide(Evidence(137, VALID, ended_early=early, timed_out=True)).reason is FailureReason.TIMEOUT


def test_a_success_says_that_a_rule_could_not_be_watched():
    assert UNSEEN in decide(Evidence(0, VALID, tracking_unseen=True)).detail
    assert UNSEEN not in decide(Evidence(0, VALID)).detail
