"""The rule that says whether a run was measured on a disturbed machine."""

import json
from dataclasses import replace

import pytest

from slamhive.base.settings import Settings
from slamhive.domain.trust import Disturbance, DisturbanceKind, DisturbanceLimits, HostInterval, HostLoad, judge

LIMITS = DisturbanceLimits(
    time_fraction=0.1,
    steal_fraction=0.05,
    others_fraction=0.25,
    cpu_pressure=0.3,
    io_pressure=0.4,
    memory_pressure=0.1,
    throttle_events=0,
    player_lag_s=0.5,
)
QUIET = HostInterval(1.0, others_cores=0.1, steal_fraction=0.0, cpu_pressure=0.02, io_pressure=0.0, memory_pressure=0.0)


def load(*intervals, **other):
    return HostLoad(cores=2, intervals=intervals, **other)


def kinds(found):
    return [reason.kind for reason in found.reasons]


def test_a_quiet_machine_does_not_disturb():
    found = judge(load(*[QUIET] * 10), 10.0, 0.01, LIMITS)
    assert found == Disturbance(known=True)
    assert found.disturbed is False


def test_the_load_of_others_is_told_in_words():
    busy = replace(QUIET, others_cores=1.7)
    found = judge(load(*[busy] * 8, *[QUIET] * 2), 10.0, None, LIMITS)
    assert found.disturbed
    assert found.words == "other processes used more than 0.5 of 2 cores for 80 % of the run (1.4 on average)"
    assert found.remedies == ("stop other programs and run it again",)


def test_a_moment_of_load_does_not_count_but_a_burst_does():
    busy = replace(QUIET, others_cores=2.0)
    assert judge(load(busy, *[QUIET] * 19), 20.0, None, LIMITS).disturbed is False
    assert judge(load(busy, *[QUIET] * 8), 9.0, None, LIMITS).disturbed is True


@pytest.mark.parametrize(
    ("changed", "kind"),
    [
        ({"steal_fraction": 0.2}, DisturbanceKind.STEAL),
        ({"others_cores": 0.6}, DisturbanceKind.OTHERS),
        ({"cpu_pressure": 0.5, "others_cores": 0.3}, DisturbanceKind.CPU_PRESSURE),
        ({"io_pressure": 0.5}, DisturbanceKind.IO_PRESSURE),
        ({"memory_pressure": 0.2}, DisturbanceKind.MEMORY_PRESSURE),
    ],
)
def test_each_limit_counts(changed, kind):
    found = judge(load(*[replace(QUIET, **changed)] * 10), 10.0, None, LIMITS)
    assert kinds(found) == [kind]
    assert found.words
    assert len(found.remedies) == 1


def test_a_run_that_makes_its_own_threads_wait_is_not_disturbed():
    found = judge(load(*[replace(QUIET, cpu_pressure=0.9)] * 10), 10.0, None, LIMITS)
    assert found.disturbed is False


def test_heat_and_a_late_player_count_once_for_the_run():
    found = judge(load(*[QUIET] * 10, throttle_events=3), 10.0, 0.8, LIMITS)
    assert kinds(found) == [DisturbanceKind.THROTTLING, DisturbanceKind.PLAYER_LAG]
    assert found.words == "the processor was too hot and slowed down 3 times; the player was up to 0.8 s late"


def test_what_was_not_watched_is_unknown_not_undisturbed():
    nothing = judge(HostLoad(not_measured=("the machine",)), 10.0, None, LIMITS)
    assert nothing.disturbed is None
    assert nothing.not_measured == ("the machine",)
    little = judge(load(QUIET), 10.0, None, LIMITS)
    assert little.disturbed is None
    assert little.not_measured == ("the machine was watched for 1.0 s of 10.0 s",)
    virtual = judge(load(QUIET, not_measured=("CPU frequency: no file",)), 10.0, None, LIMITS)
    assert virtual.not_measured == ("the machine was watched for 1.0 s of 10.0 s", "CPU frequency: no file")


def test_a_reason_counts_although_little_was_watched():
    found = judge(HostLoad(), 10.0, 2.0, LIMITS)
    assert found.disturbed is True


def test_what_is_missing_does_not_hide_the_rest():
    blind = HostInterval(1.0, others_cores=1.9)
    assert kinds(judge(load(*[blind] * 4), 4.0, None, LIMITS)) == [DisturbanceKind.OTHERS]


@pytest.mark.parametrize("known", [True, False])
def test_json_keeps_everything(known):
    found = judge(
        load(*[replace(QUIET, steal_fraction=0.5)] * 3, not_measured=("throttling: no file",)), 3.0, None, LIMITS
    )
    found = found if known else Disturbance(known=False, not_measured=("the machine",))
    assert Disturbance.of(json.loads(json.dumps(found.content))) == found


def test_the_default_limits_are_those_tested_here():
    names = DisturbanceLimits.__dataclass_fields__
    assert DisturbanceLimits(**{name: getattr(Settings(), f"disturbed_{name}") for name in names}) == LIMITS
