"""The rule of failure: each reason, its limits, its words, and what repeats tell."""

import pytest

from slamhive.domain.verdict import (
    DEFAULT_RULE,
    ERROR_OVER_REPEATS,
    REPEATS_LIMIT,
    FailureRule,
    VerdictKind,
    compare_repeats,
    ended_badly,
    judge,
    not_evaluable,
    tracked_enough,
)

STILL = "the error of an estimate that never moves"
SOUND = {
    "ate.rmse": 0.1,
    "tracked.path": 0.95,
    "tracked_fraction": 0.2,
    "ate.per_path": 0.2,
    "ate.per_extent": 4.0,
}


def outcome(errors_m):
    """The kinds of verdict on repeats that differ in nothing but their error."""
    repeats = compare_repeats(errors_m, errors_m)
    return {run: judge({**SOUND, "ate.rmse": error, **repeats.get(run, {})}).kind for run, error in errors_m.items()}


def failed(errors_m):
    return {run for run, kind in outcome(dict(enumerate(errors_m))).items() if kind.failed}


def test_a_sound_keyframe_run_is_good_although_it_covers_little_time():
    verdict = judge(SOUND)
    assert (verdict.kind, verdict.dated) == (VerdictKind.GOOD, False)
    assert verdict.words == (
        "The run ended well and tracked 95 % of the path with an ATE RMSE of 0.1 m (0.2 % of the path). "
        "There are too few repeats to tell an outlier."
    )


@pytest.mark.parametrize(
    ("changed", "kind", "words"),
    [
        (
            {"frames.dropped_fraction": 0.54},
            VerdictKind.MISSED_INPUT,
            "The run missed 54 % of the input frames; 50 % are allowed.",
        ),
        (
            {"frames.dropped_fraction": 0.3, ERROR_OVER_REPEATS: 7.0, REPEATS_LIMIT: 8.0},
            VerdictKind.MISSED_INPUT,
            (
                "The run missed 30 % of the input frames, and its ATE RMSE is 7 times the median of its repeats; "
                "above 25 % missed, 4 times are allowed."
            ),
        ),
        ({"tracked.path": 0.69}, VerdictKind.TRACKED_TOO_LITTLE, "The run tracked 69 % of the path; 70 % are needed."),
        (
            {"ate.rmse": 6.0, "ate.per_path": 5.5},
            VerdictKind.DIVERGED_FAR,
            "The run diverged: its ATE RMSE of 6 m is 5.5 % of the path; 5 % are allowed.",
        ),
        (
            {"ate.rmse": 1.4, "ate.per_path": 2.0, "ate.per_extent": 70.0},
            VerdictKind.DIVERGED_FAR,
            f"The run diverged: its ATE RMSE of 1.4 m is 70 % of {STILL}; 50 % are allowed.",
        ),
        (
            {"ate.rmse": 1.4, ERROR_OVER_REPEATS: 9.0, REPEATS_LIMIT: 5.0},
            VerdictKind.DIVERGED_OUTLIER,
            "The run diverged: its ATE RMSE of 1.4 m is 9 times the median of its repeats; 5 times are allowed.",
        ),
    ],
)
def test_each_reason_is_told_with_its_number_and_its_limit(changed, kind, words):
    verdict = judge(SOUND | changed)
    assert (verdict.kind, verdict.words) == (kind, words)


def test_frames_that_were_missed_without_harm_leave_a_run_good():
    beside_repeats = {ERROR_OVER_REPEATS: 7.0, REPEATS_LIMIT: 8.0}
    assert not judge({**SOUND, "frames.dropped_fraction": 0.5}).failed
    assert not judge({**SOUND, "frames.dropped_fraction": 0.25, **beside_repeats}).failed
    assert not judge({**SOUND, "frames.dropped_fraction": 0.3, **beside_repeats, ERROR_OVER_REPEATS: 3.9}).failed


def test_a_run_that_missed_too_much_input_is_no_measure_for_its_repeats():
    assert not tracked_enough({**SOUND, "frames.dropped_fraction": 0.54})
    far = {ERROR_OVER_REPEATS: 7.0, REPEATS_LIMIT: 8.0}
    assert tracked_enough({**SOUND, "frames.dropped_fraction": 0.3, **far})


def test_two_centimetres_are_no_divergence_however_short_the_path():
    assert not judge({**SOUND, "ate.rmse": 0.02, "ate.per_path": 20.0, "ate.per_extent": 90.0}).failed
    assert failed([0.01, 0.01, 0.01, 0.02, 0.09]) == set()


@pytest.mark.parametrize("errors_m", [[0.1, 0.12, 1.4], [0.1, 0.15, 1.4], [0.1, 0.11, 0.15, 0.2, 1.4]])
def test_one_that_diverged_by_more_than_a_metre_is_an_outlier_among_three_repeats_or_more(errors_m):
    assert failed(errors_m) == {len(errors_m) - 1}


def test_two_of_six_that_diverged_are_found():
    assert failed([0.12, 0.15, 0.1, 0.13, 1.4, 1.41]) == {4, 5}


def test_repeats_that_differ_by_a_few_times_are_good():
    assert failed([0.047, 0.046, 0.263, 0.084, 0.131]) == set()
    assert failed([0.196, 0.408, 0.145, 0.174, 0.123]) == set()


def test_two_repeats_cannot_tell_which_is_the_outlier():
    assert compare_repeats({1: 0.1, 2: 5.0}, {1: 0.1, 2: 5.0}) == {}


def test_a_lost_run_does_not_count_among_the_repeats_but_is_compared():
    found = compare_repeats({1: 0.1, 2: 0.1, 3: 0.1, 4: 0.001}, {1: 0.1, 2: 0.1, 3: 0.1})
    assert found[4][ERROR_OVER_REPEATS] == pytest.approx(0.01)
    assert not tracked_enough({**SOUND, "tracked.path": 0.1})


def test_an_estimate_without_any_error_is_compared_too():
    assert failed([0.0, 0.0, 0.0, 0.0]) == set()


def test_an_evaluation_from_before_the_rule_is_judged_by_what_it_has_and_says_so():
    old = {"ate.rmse": 0.1, "tracked_fraction": 0.8}
    verdict = judge(old)
    assert (verdict.kind, verdict.dated) == (VerdictKind.GOOD, True)
    assert "evaluate the run again to renew it" in verdict.words
    lost = judge({**old, "tracked_fraction": 0.74})
    assert (lost.kind, lost.dated) == (VerdictKind.TRACKED_TOO_LITTLE, True)
    assert "74 % of the time; 75 % are needed" in lost.words
    assert not tracked_enough({"ate.rmse": 0.1, "tracked_fraction": 0.5})


def test_a_run_without_a_ground_truth_trajectory_says_that_little_can_be_told():
    verdict = judge({"relations.translation.mean": 0.1})
    assert (verdict.kind, verdict.dated) == (VerdictKind.GOOD, False)
    assert "no ground-truth trajectory" in verdict.words


def test_what_ended_badly_or_could_not_be_evaluated_names_its_reason():
    assert ended_badly("lost_tracking").words == "The run did not end well: lost tracking."
    assert not_evaluable("no pose matches").words == "The run could not be evaluated: no pose matches"
    assert all(kind.failed == (kind is not VerdictKind.GOOD) for kind in VerdictKind)


def test_another_rule_may_be_stricter_looser_or_leave_parts_out():
    assert judge(SOUND, FailureRule(tracked_fraction_below=0.75)).kind is VerdictKind.TRACKED_TOO_LITTLE
    assert judge(SOUND, FailureRule(ate_rmse_above_m=0.05)).kind is VerdictKind.DIVERGED_FAR
    off = FailureRule(None, None, None, None, None, outliers=False, missed_input_above=None)
    bad = {
        "frames.dropped_fraction": 0.9,
        "ate.rmse": 9.0,
        "tracked.path": 0.0,
        "tracked_fraction": 0.0,
        "ate.per_path": 90.0,
    }
    assert not judge(bad | {ERROR_OVER_REPEATS: 90.0, REPEATS_LIMIT: 5.0}, off).failed


def test_the_rule_is_stated_in_words():
    assert DEFAULT_RULE.words == (
        "A run counts as failed if it did not end well, could not be evaluated, missed more than 50 % of the input, "
        "tracked less than 70 % of the path or diverged. It diverged if its ATE RMSE is above 5 % of the path, "
        "above 50 % of the error of standing still or more than 4 to 6 times the median of 3 or more repeats."
    )
    assert FailureRule(None, None, None, None, None, outliers=False, missed_input_above=None).words == (
        "A run counts as failed if it did not end well or could not be evaluated."
    )


RELATIONS = {
    "relations.translation.rmse": 0.04,
    "relations.translation.per_motion": 9.0,
    "relations.matched_fraction": 0.98,
}


@pytest.mark.parametrize(
    ("changed", "kind", "words"),
    [
        (
            {},
            VerdictKind.GOOD,
            "poses for 98 % of the relations. Their translation errors have an RMSE of 0.04 m (9 %",
        ),
        (
            {"relations.translation.rmse": 46.0, "relations.translation.per_motion": 9000.0},
            VerdictKind.DIVERGED_FAR,
            f"have an RMSE of 46 m, which is 9e+03 % of {STILL}; 50 % are allowed.",
        ),
        ({"relations.translation.per_motion": 80.0}, VerdictKind.GOOD, "0.04 m (80 % of their motion)"),
        (
            {"relations.matched_fraction": 0.5},
            VerdictKind.TRACKED_TOO_LITTLE,
            "The run tracked 50 % of the relations; 70 % are needed.",
        ),
    ],
)
def test_runs_without_a_trajectory_are_judged_by_their_relations(changed, kind, words):
    verdict = judge({**RELATIONS, **changed})
    assert (verdict.kind, verdict.dated) == (kind, False)
    assert words in verdict.words


def test_relations_beside_a_trajectory_change_no_verdict():
    assert judge({**SOUND, **RELATIONS, "relations.translation.per_motion": 900.0}) == judge(SOUND)


def test_an_older_evaluation_of_relations_is_good():
    assert judge({"relations.translation.mean": 46.0}).kind is VerdictKind.GOOD
