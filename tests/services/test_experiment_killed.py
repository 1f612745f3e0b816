"""An experiment runs unattended, its worker is killed in the middle, and every cell is accounted for."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from slamhive.domain.run import FailureReason, RunState
from slamhive.services.experiments.records import ExperimentSource
from tests.services.test_worker_recovery import processes_of, started_times

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[2]
EXPERIMENT = """
name: unattended
algorithms: tiny
datasets: track
parameters: {behaviour: good | lost | crash, seconds: 1.5}
repeats: 2
stop_when: {lost_tracking_s: 0.4, failures_of_configuration: 1}
evaluate: false
executor: process
"""


def worker() -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", "slamhive", "worker"], cwd=CHECKOUT)


def test_a_killed_worker_costs_an_experiment_nothing(hive):
    hive.executor("process").build(hive.catalogue.algorithm("tiny").package, lambda _line: None)
    hive.experiments.start(ExperimentSource(EXPERIMENT, "unattended.yaml"))
    ids = hive.experiments.run_ids("unattended")
    assert len(ids) == 6
    first = worker()
    try:
        wait(lambda: hive.counts()[RunState.SUCCEEDED] >= 1 and hive.counts()[RunState.RUNNING] == 1)
        (running,) = (run_id for run_id in ids if hive.run(run_id).state is RunState.RUNNING)
    finally:
        first.kill()
        first.wait()
    second = worker()
    try:
        wait(lambda: all(hive.run(run_id).state.ended for run_id in ids))
    finally:
        second.terminate()
        second.wait()
    assert hive.run(running).attempt == 2
    assert started_times(hive, running) == 1
    ended = [hive.run(run_id) for run_id in ids]
    assert {(run.parameters["behaviour"], run.reason) for run in ended} == {
        ("good", None),
        ("lost", FailureReason.LOST_TRACKING),
        ("lost", FailureReason.CONFIGURATION_FAILED),
        ("crash", FailureReason.NONZERO_EXIT),
        ("crash", FailureReason.CONFIGURATION_FAILED),
    }
    cells = list(hive.experiments.report("unattended"))
    assert [len(cell.runs) for cell in cells] == [2] * 3
    assert all(hive.record(run.id)["state"] == run.state.value for run in ended)
    assert processes_of(hive) == []


def wait(condition) -> None:
    """Until it is so, 180 s at most."""
    deadline_s = time.monotonic() + 180
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
