from __future__ import annotations

import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.documents.limits import NEVER, StopWhen
from slamhive.documents.submission import parse_stop_when
from slamhive.domain.configuration import VariantStep
from slamhive.domain.placement import run_affinity, same_data
from slamhive.domain.run import FailureReason


def test_rules_are_read_as_they_are_typed_and_survive_json():
    rules = parse_stop_when(["lost_tracking_s=2.5", "memory_mb=800"])
    assert rules == StopWhen(lost_tracking_s=2.5, memory_mb=800)
    assert rules.content == {"lost_tracking_s": 2.5, "memory_mb": 800}
    assert StopWhen.of(rules.content) == rules
    assert StopWhen.of({**rules.content, "of_a_newer_version": 1}) == rules
    assert parse_stop_when([]).content == {}
    assert StopWhen.of(None) == StopWhen.of({}) == NEVER


@pytest.mark.parametrize(
    ("texts", "error", "message"),
    [
        (["lost_tracking=5"], NotFound, "unknown stop rule 'lost_tracking'; did you mean 'lost_tracking_s'?"),
        (["time_s"], InvalidInput, "stop rule 'time_s' is not clear; write RULE=NUMBER"),
        (["time_s=soon"], InvalidInput, "stop rule time_s='soon' is not allowed; use a number above 0"),
        (["memory_mb=1.5"], InvalidInput, "use a whole number above 0"),
        (["time_s=0"], InvalidInput, "stop_when time_s 0 is not allowed; use a number above 0"),
        (["time_s=-1"], InvalidInput, "time_s -1 is not allowed"),
        (["time_s=nan"], InvalidInput, "time_s nan is not allowed"),
        (["time_s=inf"], InvalidInput, "time_s inf is not allowed"),
        (["failures_of_configuration=0"], InvalidInput, "failures_of_configuration 0 is not allowed"),
        (["time_s=1", "time_s=2"], InvalidInput, "stop rule time_s is given twice"),
    ],
)
def test_a_rule_that_makes_no_sense_is_refused(texts, error, message):
    with pytest.raises(error) as refused:
        parse_stop_when(texts)
    assert message in str(refused.value)


def test_what_was_taken_away_or_not_tried_blames_no_configuration():
    blamed = {reason for reason in FailureReason if reason.blames_configuration}
    assert set(FailureReason) - blamed == {FailureReason.LOST, FailureReason.CONFIGURATION_FAILED}


def test_runs_on_the_same_data_have_affinities_side_by_side():
    half = (VariantStep("resolution", ("cam0",), {"scale": 0.5}),)
    mono, stereo = run_affinity("room", half, "orb-slam3"), run_affinity("room", half, "other")
    first, behind = same_data(mono)
    assert mono != stereo
    assert first <= mono < behind
    assert first <= stereo < behind
    for elsewhere in (run_affinity("room", (), "orb-slam3"), run_affinity("kitti", half, "orb-slam3")):
        assert not first <= elsewhere < behind
    assert len(mono) == len(stereo) == 25
