"""What plans warn of, and what progress is counted from."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from typing import Any, cast

import pytest

from slamhive.clock import Clock
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.services.experiments.axis_table import AxisTable
from slamhive.services.experiments.time_left import KEPT_S, MANY_RUNS, Left, TimeLeft
from slamhive.services.experiments.views import Phase
from slamhive.services.hive import Hive
from slamhive.store.durations import ActiveRun, Pairing, Unfinished
from slamhive.store.experiment_records import CellRecord, StateCount
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
    assert [cell.counts[Phase.FAILED] for cell in grid.cells.values()] == [4, 2]
    assert [cell.counts[Phase.GOOD] for cell in grid.cells.values()] == [0, 4]
    assert [cell.counts[Phase.UNJUDGED] for cell in grid.cells.values()] == [0, 1]


class Durations:
    """Ten runs of 3 s wait, half of which will be evaluated; ``looks`` counts how often the runs were looked at."""

    def __init__(self) -> None:
        self.looks = 0
        self.claimed_at: list[datetime] = []
        self.evaluations = 0
        self.not_built: list[str] = []
        self.state = RunState.RUNNING

    def unfinished(self, _id: int) -> dict[Pairing, Unfinished]:
        self.looks += 1
        return {PAIRING: Unfinished(10, 5)}

    def of_pairings(self, _id: int | None = None) -> dict[Pairing, float]:
        return {PAIRING: 3.0}

    def active(self, _id: int) -> list[ActiveRun]:
        return [ActiveRun(number, at, self.state, "a") for number, at in enumerate(self.claimed_at)]

    def unbuilt(self, _id: int) -> list[str]:
        return self.not_built

    def build_s(self) -> float | None:
        return 100.0

    def overhead_s(self) -> float:
        return 1.0

    def evaluation_s(self) -> float:
        return 2.0

    def open_evaluations(self, _id: int) -> int:
        return self.evaluations


PAIRING: Pairing = ("a", "d", PlaybackMode.REALTIME, 1.0)
NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


def estimate(slots: int) -> tuple[Durations, list[float], Callable[[int], Left]]:
    """The durations that are known, a clock to move, and the estimate for so many waiting runs."""
    durations, now_s = Durations(), [0.0]
    t = cast("Any", SimpleNamespace(durations=durations, catalogue=SimpleNamespace(datasets=list)))
    clock = Clock(utc_now=lambda: NOON + timedelta(seconds=now_s[0]), monotonic_s=lambda: now_s[0])
    left = TimeLeft(slots, clock)
    return durations, now_s, lambda waiting: left.of(t, cast("Any", SimpleNamespace(id=7, cpu_model=None)), waiting)


def time_left(slots: int) -> tuple[Durations, list[float], Callable[[int], float]]:
    """The same in seconds."""
    durations, now_s, of = estimate(slots)
    return durations, now_s, lambda waiting: of(waiting).seconds


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
    assert of(1) == pytest.approx(0.1 * 4 + 1)  # it takes longer than any before: it is never said to be over
    durations.claimed_at, durations.evaluations = [], 3
    assert of(0) == 6


def test_time_left_counts_builds_and_says_what_happens_now() -> None:
    durations, now_s, of = estimate(slots=1)
    assert of(1) == (5, "waiting for a worker")
    durations.not_built = ["a"]
    assert of(1) == (105, "waiting for a worker")
    durations.claimed_at, durations.state = [NOON], RunState.PREPARING
    now_s[0] = 60.0
    assert of(1) == (45, "building a")
    durations.not_built = []
    assert of(1).seconds == pytest.approx(0.1 * 4 + 1)
    assert of(1).phase == "preparing 1 run"
    durations.state, durations.evaluations = RunState.RUNNING, 2
    assert of(1).seconds == pytest.approx(0.1 * 4 + 1 + 4)
    assert of(1).phase == "1 run under way, 2 evaluations to do"
