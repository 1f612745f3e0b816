"""What plans warn of, and what progress is counted from."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.services.experiments.axis_table import AxisTable
from slamhive.services.experiments.time_left import KEPT_S, MANY_RUNS, TimeLeft
from slamhive.services.experiments.views import Phase
from slamhive.services.hive import Hive
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


def test_the_mean_of_many_runs_is_kept_for_a_minute_and_of_few_never() -> None:
    looks: list[int] = []
    now_s = [0.0]
    pairing = ("a", "d", "realtime", 1.0)

    def unfinished(experiment_id: int) -> dict[Any, int]:
        looks.append(experiment_id)
        return {pairing: 10}

    durations = SimpleNamespace(unfinished=unfinished, of_pairings=lambda _id=None: {pairing: 3.0})
    t = cast("Any", SimpleNamespace(durations=durations, catalogue=SimpleNamespace(datasets=list)))
    record = cast("Any", SimpleNamespace(id=7))
    left = TimeLeft(2, lambda: now_s[0])
    assert left.of(t, record, MANY_RUNS) == MANY_RUNS * 1.5
    assert left.of(t, record, MANY_RUNS + 2) == (MANY_RUNS + 2) * 1.5
    assert looks == [7]
    now_s[0] = KEPT_S + 1
    left.of(t, record, MANY_RUNS)
    assert left.of(t, record, 0) == 0
    assert left.of(t, record, 10) == 15
    assert looks == [7, 7, 7]
