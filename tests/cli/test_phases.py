"""Phases of a long command, and the time left that they show."""

from __future__ import annotations

import pytest

from slamhive.cli.output import counting_bar
from slamhive.cli.phases import Phase, Phases, words

BUILDS = [Phase("building a", 60.0, "build"), Phase("building b", 60.0, "build"), Phase("runs", 30.0, "run")]


@pytest.fixture
def now_s() -> list[float]:
    return [1000.0]


@pytest.fixture
def phases(now_s: list[float]) -> Phases:
    return Phases(BUILDS, lambda: now_s[0])


def test_what_a_phase_took_corrects_those_of_its_kind_alone(
    phases: Phases, now_s: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    assert phases.after_s() == 150
    with phases.next() as show:
        assert phases.left_s(20) == 130
        now_s[0] += 120
        show(1.0, "ready")
    assert phases.after_s() == 120 + 30
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "step 1 of 3, building a: begins – about 2.5 min left in all (0%, 0 s)"
    assert lines[-1].startswith("step 1 of 3, building a: ready (100%")
    assert "left" not in lines[-1]


def test_a_phase_that_takes_longer_than_expected_is_never_about_to_end(phases: Phases) -> None:
    with phases.next():
        assert phases.left_s(44) == 16 + 90
        assert phases.left_s(60) == 20 + 90
        assert phases.left_s(600) == 200 + 90


def test_a_fraction_is_better_than_an_expectation(phases: Phases) -> None:
    with phases.next():
        assert phases.left_s(50, 0.25) == 150 + 90
        assert phases.left_s(5, 0.05) == 55 + 90, "too little is done to go by it"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "about 5 s"),
        (42, "about 40 s"),
        (57, "about 55 s"),
        (60, "about 1.0 min"),
        (100, "about 1.7 min"),
        (600, "about 10 min"),
        (9000, "about 2.5 h"),
    ],
)
def test_no_more_exact_than_it_is_known(seconds: float, text: str) -> None:
    assert words(seconds) == text


def test_a_counting_bar_says_how_many_of_how_many(capsys: pytest.CaptureFixture[str]) -> None:
    with counting_bar("runs", 4, tells_left=False) as show:
        show(0, "1 failed")
        show(4, "")
    assert capsys.readouterr().err.splitlines() == ["runs: 0 of 4, 1 failed (0%, 0 s)", "runs: 4 of 4 (100%, 0 s)"]
