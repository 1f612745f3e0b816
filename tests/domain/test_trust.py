"""The rule of trust: each limit, its words, and what is missing."""

import pytest

from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.trust import (
    CPU_LIMIT_USED,
    DISTURBED,
    DROPPED_FRAMES,
    LIMITS,
    PLAYER_LAG,
    Disturbance,
    DisturbanceKind,
    DisturbanceReason,
    TrustLevel,
    judge_trust,
)

QUIET = Disturbance(known=True)
BUSY = Disturbance(known=True, reasons=(DisturbanceReason(DisturbanceKind.OTHERS, "others were busy"),))
LATE = DisturbanceReason(DisturbanceKind.PLAYER_LAG, "the player was up to 3 s late")
SOUND = {DROPPED_FRAMES: 0.0, PLAYER_LAG: 0.01, CPU_LIMIT_USED: 0.4}
HIGH, LIMITED, LOW = TrustLevel


def test_a_run_that_took_all_frames_on_a_quiet_machine_is_trusted():
    found = judge_trust(SOUND, QUIET, realtime=True)
    assert (found.level, found.reasons, found.words) == (HIGH, (), "")


@pytest.mark.parametrize(
    ("changed", "level"),
    [
        ({DROPPED_FRAMES: 0.05}, HIGH),
        ({DROPPED_FRAMES: 0.06}, LIMITED),
        ({DROPPED_FRAMES: 0.79}, LOW),
        ({PLAYER_LAG: 0.6}, LIMITED),
        ({PLAYER_LAG: 2.5}, LOW),
        ({CPU_LIMIT_USED: 0.95}, LIMITED),
        ({CPU_LIMIT_USED: 0.95, DROPPED_FRAMES: 0.5}, LOW),
    ],
)
def test_each_limit_counts(changed, level):
    found = judge_trust({**SOUND, **changed}, QUIET, realtime=True)
    assert found.level is level
    assert {reason.kind for reason in found.reasons} == (set(changed) if level is not HIGH else set())
    assert all(reason.remedy for reason in found.reasons)


def test_the_words_say_what_was_measured():
    found = judge_trust({**SOUND, DROPPED_FRAMES: 0.79, CPU_LIMIT_USED: 0.99}, QUIET, realtime=True)
    assert found.words == (
        "the algorithm was too slow for 79 % of the frames, which were dropped; "
        "the run used 99 % of the CPU time that its limit allows"
    )


def test_playback_that_waits_may_use_all_of_its_cores():
    assert judge_trust({CPU_LIMIT_USED: 1.0}, QUIET, realtime=False).level is HIGH


def test_a_disturbed_machine_limits_the_trust():
    found = judge_trust(SOUND, BUSY, realtime=True)
    assert [(reason.kind, reason.level) for reason in found.reasons] == [(DISTURBED, LIMITED)]
    assert found.words == "measured on a disturbed machine: others were busy"


def test_a_late_player_is_named_once():
    late = Disturbance(known=True, reasons=(LATE,))
    assert [reason.kind for reason in judge_trust({**SOUND, PLAYER_LAG: 3.0}, late, realtime=True).reasons] == [
        PLAYER_LAG
    ]
    assert [reason.kind for reason in judge_trust(SOUND, late, realtime=True).reasons] == [DISTURBED]


@pytest.mark.parametrize(
    ("metrics", "disturbance", "realtime", "missing"),
    [
        ({}, QUIET, True, 1),
        ({}, None, True, 2),
        (SOUND, Disturbance(known=False), True, 1),
        ({}, None, False, 1),
    ],
)
def test_what_was_not_measured_is_no_trust(metrics, disturbance, realtime, missing):
    found = judge_trust(metrics, disturbance, realtime=realtime)
    assert (found.level, len(found.not_measured)) == (None, missing)
    assert found.words


def test_every_limit_is_of_a_metric_that_is_measured():
    assert all(not CATALOGUE[limit.metric].needs_protocol for limit in LIMITS)
