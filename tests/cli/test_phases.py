"""Phases of a long command, and the time left that they show."""

from __future__ import annotations

import itertools

import pytest

from slamhive.cli.demo import DemoPhase, Phases
from slamhive.cli.output import counting_bar

BUILDS = [
    DemoPhase("building a", 60.0, "build"),
    DemoPhase("building b", 60.0, "build"),
    DemoPhase("runs", 30.0, "run"),
]
DEMO = [
    DemoPhase("building kiss-icp", 60.0, "build"),
    DemoPhase("building rko-lio", 1.0, "build"),
    DemoPhase("building the evaluation", 60.0, "build"),
    DemoPhase("rendering room", 15.0, "render"),
    DemoPhase("runs", 66.0, "run", 45.0),
]
"""The demo where one environment is there already: what it expects on the reference machine."""
RECORDED_S = {
    "reference": [55.0, 1.2, 48.0, 14.0, 68.0],
    "ten times slower": [560.0, 13.0, 470.0, 160.0, 245.0],
    "a slow network": [640.0, 1.1, 590.0, 15.0, 66.0],
    "all cached": [4.0, 0.5, 3.0, 14.0, 64.0],
    "a slow start": [70.0, 30.0, 60.0, 17.0, 75.0],
}
"""What the phases took, in seconds."""


@pytest.fixture
def now_s() -> list[float]:
    return [1000.0]


@pytest.fixture
def phases(now_s: list[float]) -> Phases:
    return Phases(BUILDS, lambda: now_s[0])


def replayed(expected: list[DemoPhase], took_s: list[float], slowness: float = 1.0) -> tuple[list[float], list[bool]]:
    """Each second of a demo: how long it would take in all, and whether the interval held what was left."""
    now_s, totals_s, held = [0.0], [], []
    phases = Phases(expected, lambda: now_s[0], slowness)
    whole_s = sum(took_s)
    for took in took_s:
        began_s = now_s[0]
        with phases.next():
            while now_s[0] < began_s + took:
                left = phases.left(now_s[0] - began_s)
                assert left.low_s is not None
                assert left.high_s is not None
                totals_s.append(now_s[0] + left.seconds)
                held.append(left.low_s <= whole_s - now_s[0] <= left.high_s)
                now_s[0] = min(began_s + took, now_s[0] + 1.0)
    return totals_s, held


@pytest.mark.parametrize("name", RECORDED_S)
def test_the_time_of_the_whole_is_never_far_beyond_what_it_becomes(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    took_s = RECORDED_S[name]
    totals_s, _ = replayed(DEMO, took_s)
    assert max(totals_s) < 1.7 * max(sum(took_s), totals_s[0])
    assert max(totals_s) < 10 * totals_s[0]
    steps = [later / before for before, later in itertools.pairwise(totals_s)]
    assert max(steps) < 1.5, "it grows bit by bit, and never at once"
    assert totals_s[-1] == pytest.approx(sum(took_s), rel=0.4)


def test_a_short_phase_says_little_of_long_ones(capsys: pytest.CaptureFixture[str]) -> None:
    """An environment that is there took 13 s instead of 1 s: the next one does not take 13 min for that."""
    phases = Phases(DEMO[1:])
    before_s = phases.after().seconds
    with phases.next():
        assert before_s < phases.left(13.0).seconds < 2.5 * before_s


def test_the_speed_of_the_machine_is_known_before_the_first_phase(capsys: pytest.CaptureFixture[str]) -> None:
    took_s = RECORDED_S["ten times slower"]
    totals_s, held = replayed(DEMO, took_s, slowness=10.0)
    assert 0.6 * sum(took_s) < min(totals_s) < max(totals_s) < 1.5 * sum(took_s)
    assert sum(held) > 0.8 * len(held)


def test_what_is_played_takes_no_longer_on_a_slow_machine() -> None:
    recording = [DemoPhase("runs", 50.0, "run", 45.0)]
    assert Phases(recording, slowness=10.0).after().seconds == pytest.approx(45 + 50)


def test_what_a_phase_took_corrects_those_of_its_kind_most(
    phases: Phases, now_s: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    assert phases.after().seconds == pytest.approx(150)
    with phases.next() as show:
        assert phases.left(20).seconds == pytest.approx(130)
        now_s[0] += 120
        show(1.0, "ready")
    assert 1.5 * 90 < phases.after().seconds < 2 * 90
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "step 1 of 3, building a: begins – 55 s to 7 min left in all (0%, 0 s)"
    assert lines[-1].startswith("step 1 of 3, building a: ready (100%")
    assert "left" not in lines[-1]


def test_another_kind_is_corrected_less(now_s: list[float]) -> None:
    def after_twice_as_long(kind: str) -> float:
        phases = Phases([BUILDS[0], DemoPhase("next", 60.0, kind)], lambda: now_s[0])
        with phases.next():
            now_s[0] += 120
        return phases.after().seconds

    assert 60 < after_twice_as_long("run") < after_twice_as_long("build") < 120


def test_the_interval_narrows_as_phases_end(phases: Phases, now_s: list[float]) -> None:
    def width() -> float:
        found = phases.after()
        assert found.low_s is not None
        assert found.high_s is not None
        return found.high_s / found.low_s

    before = width()
    with phases.next():
        now_s[0] += 60
    assert width() < 0.8 * before


def test_a_phase_that_takes_longer_than_expected_is_never_about_to_end(phases: Phases) -> None:
    with phases.next():
        assert phases.left(44).seconds == pytest.approx(16 + 90)
        lefts_s = [phases.left(float(elapsed_s)).seconds for elapsed_s in range(44, 600)]
        assert lefts_s[-1] > 600 / 3 + 5 * 60
        assert all(abs(later - before) < 6 for before, later in itertools.pairwise(lefts_s))


def test_a_fraction_is_better_than_an_expectation(phases: Phases) -> None:
    with phases.next():
        assert phases.left(15, 0.25).seconds == pytest.approx(45 + 90)
        assert phases.left(100, 0.25).seconds > 300 + 3 * 60
        assert phases.left(5, 0.05).seconds == pytest.approx(55 + 90), "too little is done to say more"


def test_a_counting_bar_says_how_many_of_how_many(capsys: pytest.CaptureFixture[str]) -> None:
    with counting_bar("runs", 4, tells_left=False) as show:
        show(0, "1 failed")
        show(4, "")
    assert capsys.readouterr().err.splitlines() == ["runs: 0 of 4, 1 failed (0%, 0 s)", "runs: 4 of 4 (100%, 0 s)"]
