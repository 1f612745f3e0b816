"""An experiment runs unattended, its worker is killed in the middle, and every cell is accounted for."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from slamhive.domain.run import FailureReason, RunState
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive
from tests.services.test_worker_recovery import processes_of
from tests.services.working import started_times
from tests.waiting import eventually

pytestmark = [pytest.mark.integration, pytest.mark.timeout(600)]

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
    hive.executors.get("process").build(hive.catalogue.algorithm("tiny").package, lambda _line: None)
    hive.experiments.start(ExperimentSource(EXPERIMENT, "unattended.yaml"))
    ids = hive.experiments.run_ids("unattended")
    assert len(ids) == 6
    first = worker()
    try:
        eventually(lambda: stopped_while_one_runs(first, hive), "a run in the middle of the experiment")
        (running,) = (run_id for run_id in ids if hive.runs.get(run_id).state is RunState.RUNNING)
    finally:
        first.kill()
        first.wait()
    second = worker()
    try:
        eventually(lambda: all(hive.runs.get(run_id).state.ended for run_id in ids), "the end of all runs")
    finally:
        second.terminate()
        second.wait()
    assert hive.runs.get(running).attempt == 2
    assert started_times(hive, running) == 1
    ended = [hive.runs.get(run_id) for run_id in ids]
    assert {(run.parameters["behaviour"], run.reason) for run in ended} == {
        ("good", None),
        ("lost", FailureReason.LOST_TRACKING),
        ("lost", FailureReason.CONFIGURATION_FAILED),
        ("crash", FailureReason.NONZERO_EXIT),
        ("crash", FailureReason.CONFIGURATION_FAILED),
    }
    cells = list(hive.experiments.report("unattended"))
    assert [len(cell.runs) for cell in cells] == [2] * 3
    assert all(hive.runs.record(run.id)["state"] == run.state.value for run in ended)
    assert processes_of(hive) == []


def stopped_while_one_runs(process: subprocess.Popen[bytes], hive: Hive) -> bool:
    """Whether the worker, who is stopped then and changes nothing any more, has ended a run and is at another."""
    if hive.runs.counts()[RunState.SUCCEEDED] == 0:
        return False
    process.send_signal(signal.SIGSTOP)
    os.waitpid(process.pid, os.WUNTRACED)
    if hive.runs.counts()[RunState.RUNNING] == 1:
        return True
    process.send_signal(signal.SIGCONT)
    return False
