"""What plans warn of, what progress is counted from, and the time left with its interval."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from random import Random
from statistics import fmean, stdev
from types import SimpleNamespace
from typing import Any, cast

import pytest

from slamhive.base.clock import Clock
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.placement import Remaining
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import Outcome, VerdictKind
from slamhive.services.experiments.context import GUESSED_START_S, Expected
from slamhive.services.experiments.progress import KEPT_S, MANY_RUNS, AxisTable, Left, TimeLeft
from slamhive.services.hive import Hive
from slamhive.store.durations import ActiveRun, Measured, Pairing, Unfinished
from slamhive.store.records import CellRecord, StateCount
from tests.services.test_experiments import SIX, source


@pytest.mark.integration
def test_a_plan_warns_once_where_lost_tracking_cannot_be_watched(hive: Hive) -> None:
    assert hive.experiments.preview(source(SIX)).warnings == ()
    warned = hive.experiments.preview(source(SIX.replace("time_s: 30", "lost_tracking_s: 2"))).warnings
    text = "stop_when: lost_tracking_s has no effect on tiny, which does not say which frames are tracked"
    assert warned == (text,)


def test_the_grid_counts_failures_by_reason() -> None:
    cells = [CellRecord(number, "", number + 10, {"rate": number % 2, "seed": 1}) for number in (1, 2, 3)]
    crashed, timeout = FailureReason.NONZERO_EXIT, FailureReason.TIMEOUT
    failed, succeeded = RunState.FAILED, RunState.SUCCEEDED
    counts = {
        1: [StateCount(failed, crashed, retried=False, count=2), StateCount(failed, crashed, retried=True, count=9)],
        2: [
            StateCount(succeeded, None, retried=False, count=4, judged=VerdictKind.GOOD),
            StateCount(succeeded, None, retried=False, count=2, judged=VerdictKind.DIVERGED_FAR),
            StateCount(succeeded, None, retried=False, count=1),
        ],
        3: [StateCount(failed, crashed, retried=False, count=1), StateCount(failed, timeout, retried=False, count=1)],
    }
    grid = AxisTable.of(cells).grid(("rate", "seed"), counts, "e")
    assert [cell.configurations for cell in grid.cells.values()] == [(11, 13), (12,)]
    diverged = {VerdictKind.DIVERGED_FAR: 2}
    assert [dict(cell.failures) for cell in grid.cells.values()] == [{crashed: 3, timeout: 1}, diverged]
    assert [cell.counts[Outcome.FAILED] for cell in grid.cells.values()] == [4, 2]
    assert [cell.counts[Outcome.GOOD] for cell in grid.cells.values()] == [0, 4]
    assert [cell.counts[Outcome.UNJUDGED] for cell in grid.cells.values()] == [0, 1]


class Durations:
    """Ten runs of 3 s wait, half of which will be evaluated; ``looks`` counts how often the runs were looked at."""

    def __init__(self) -> None:
        self.looks = 0
        self.claimed_at: list[datetime] = []
        self.evaluations = 0
        self.not_built: list[str] = []
        self.state = RunState.RUNNING
        self.runs: dict[Pairing, Measured] = {PAIRING: Measured(100, 3.0, 0.5)}
        self.waiting = {PAIRING: Unfinished(10, 5)}

    def unfinished(self, _id: int) -> dict[Pairing, Unfinished]:
        self.looks += 1
        return self.waiting

    def of_pairings(self, experiment_id: int | None = None) -> dict[Pairing, Measured]:
        return self.runs if experiment_id is None else {}

    def active(self, _id: int) -> list[ActiveRun]:
        return [ActiveRun(number, at, self.state, "a") for number, at in enumerate(self.claimed_at)]

    def unbuilt(self, _id: int) -> list[str]:
        return self.not_built

    def build(self) -> Measured | None:
        return Measured(1, 100.0, 0.0)

    def overhead(self) -> Measured | None:
        return Measured(50, 1.0, 0.1)

    def evaluation(self) -> Measured | None:
        return Measured(50, 2.0, 0.2)

    def open_evaluations(self, _id: int) -> int:
        return self.evaluations


PAIRING: Pairing = ("a", "d", PlaybackMode.REALTIME, 1.0)
NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


def estimate(slots: int) -> tuple[Durations, list[float], Callable[[int], Left]]:
    """The durations that are known, a clock to move, and the estimate for so many waiting runs."""
    durations, now_s = Durations(), [0.0]
    t = cast(
        "Any",
        SimpleNamespace(
            durations=durations,
            catalogue=SimpleNamespace(datasets=lambda: [SimpleNamespace(name="d", duration_s=60.0)]),
        ),
    )
    clock = Clock(utc_now=lambda: NOON + timedelta(seconds=now_s[0]), monotonic_s=lambda: now_s[0])
    left = TimeLeft(slots, clock)
    return durations, now_s, lambda waiting: left.of(t, cast("Any", SimpleNamespace(id=7, cpu_model=None)), waiting)


def time_left(slots: int) -> tuple[Durations, list[float], Callable[[int], float]]:
    """The same in seconds."""
    durations, now_s, of = estimate(slots)
    return durations, now_s, lambda waiting: of(waiting).time.seconds


def test_the_means_of_many_runs_are_kept_for_a_minute_and_of_few_never() -> None:
    durations, now_s, of = time_left(slots=2)
    assert of(MANY_RUNS) == MANY_RUNS * (3 + 1 + 0.5 * 2) / 2
    assert of(MANY_RUNS + 2) == (MANY_RUNS + 2) * 2.5
    assert durations.looks == 1
    now_s[0] = KEPT_S + 1
    of(MANY_RUNS)
    assert of(0) == 0
    assert of(10) == 25
    assert durations.looks == 3


def test_time_left_counts_down_while_a_run_is_under_way_and_counts_evaluations() -> None:
    durations, now_s, of = time_left(slots=1)
    durations.claimed_at = [NOON]
    assert of(1) == 3 + 1 + 0.5 * 2
    now_s[0] = 2.0
    assert of(1) == 3
    now_s[0] = 60.0
    assert of(1) == pytest.approx(60 / 3 + 1)  # the longer it has taken, the further is its end
    durations.claimed_at, durations.evaluations = [], 3
    assert of(0) == 6


def test_time_left_counts_builds_and_says_what_happens_now() -> None:
    durations, now_s, of = estimate(slots=1)
    assert (of(1).time.seconds, of(1).phase) == (5, "waiting for a worker")
    durations.not_built = ["a"]
    assert (of(1).time.seconds, of(1).phase) == (105, "waiting for a worker")
    durations.claimed_at, durations.state = [NOON], RunState.PREPARING
    now_s[0] = 60.0
    assert (of(1).time.seconds, of(1).phase) == (45, "building a")
    durations.not_built = []
    assert of(1).time.seconds == pytest.approx(60 / 3 + 1)
    assert of(1).phase == "preparing 1 run"
    durations.state, durations.evaluations = RunState.RUNNING, 2
    assert of(1).time.seconds == pytest.approx(60 / 3 + 1 + 4)
    assert of(1).phase == "1 run under way, 2 evaluations to do"


def test_without_a_measured_run_the_time_left_says_so_and_has_no_interval() -> None:
    durations, _, of = estimate(slots=1)
    durations.runs = {}
    time = of(10).time
    assert time.seconds == 10 * (60 + GUESSED_START_S + 1 + 0.5 * 2)
    assert (time.low_s, time.high_s) == (None, None)
    assert time.words() == "about 11 min left, not measured yet"


def test_a_guess_grows_bit_by_bit_while_the_first_run_takes_ten_times_as_long() -> None:
    """Not measured: four runs of 66 s each by their recordings. Each takes 660 s on this machine."""
    durations, now_s, of = estimate(slots=1)
    durations.runs, durations.claimed_at = {}, [NOON]
    wholes_s = []
    for second in range(660):
        now_s[0] = float(second)
        wholes_s.append(second + of(4).time.seconds)
    assert wholes_s[0] == pytest.approx(4 * (60 + GUESSED_START_S + 1 + 0.5 * 2))
    assert max(later / before for before, later in itertools.pairwise(wholes_s)) < 1.05
    assert 0.9 * 4 * 660 < wholes_s[-1] < 1.5 * 4 * 660
    assert of(4).time.words().endswith("left, not measured yet")


def test_the_interval_holds_nine_tenths_of_what_recorded_durations_lead_to() -> None:
    """Forty runs that follow thirty measured ones, drawn a thousand times from the same recorded durations."""
    recorded_s = [61.2, 58.9, 64.0, 75.5, 59.7, 88.1, 60.3, 62.8, 57.4, 66.6]  # start to end, one configuration
    random = Random(7)
    within = 0
    for _ in range(1000):
        first = random.choices(recorded_s, k=30)
        found = Expected.of(Measured(30, fmean(first), stdev(first))).times(40).remaining(1)
        assert found.low_s is not None
        assert found.high_s is not None
        assert found.low_s < found.seconds < found.high_s
        within += found.low_s <= sum(random.choices(recorded_s, k=40)) <= found.high_s
    assert 860 <= within <= 960


def test_the_interval_narrows_with_what_is_measured_and_widens_with_what_is_guessed() -> None:
    def width_s(n: int, std_s: float) -> float:
        found = Expected.of(Measured(n, 60.0, std_s)).times(20).remaining(1)
        return (found.high_s or 0.0) - (found.low_s or 0.0)

    assert width_s(1, 0.0) > width_s(2, 0.0) > width_s(50, 0.0) > 0
    assert width_s(50, 6.0) > width_s(50, 3.0)
    durations, _, of = estimate(slots=1)
    measured = of(10).time
    other: Pairing = ("b", "d", PlaybackMode.REALTIME, 1.0)
    durations.waiting = {PAIRING: Unfinished(5, 0), other: Unfinished(5, 0)}
    mixed = of(10).time
    assert mixed.low_s is not None
    assert mixed.high_s is not None
    assert measured.low_s is not None
    assert mixed.low_s < 5 * 65 < 2 * 5 * 65 < mixed.high_s, "a guess counts from its half to its double"
    assert mixed.low_s > measured.low_s


def test_two_workers_do_not_share_one_run() -> None:
    _, _, of = time_left(slots=2)
    assert of(1) == 3 + 1 + 0.5 * 2
    assert of(4) == 4 * 5 / 2


@pytest.mark.parametrize(
    ("time", "text"),
    [
        (Remaining(750, 541, 955), "9 to 16 min left"),
        (Remaining(780), "about 13 min left, not measured yet"),
        (Remaining(780, 770, 790), "about 13 min left"),
        (Remaining(60, 45, 125), "45 s to 2.1 min left"),
        (Remaining(9000, 7200, 14_000), "2.0 to 3.9 h left"),
        (Remaining(9000, 5000, 400_000), "83 min to 4.6 d left"),
        (Remaining(10) + Remaining(20), "about 30 s left, not measured yet"),
        (Remaining(0.0) + Remaining(20, 10, 30) + Remaining(20), "30 to 50 s left"),
    ],
)
def test_the_time_left_in_words(time: Remaining, text: str) -> None:
    assert time.words() == text
