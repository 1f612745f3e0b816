"""Many evaluations: queued at once, none twice, none lost when whoever works on them is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import psutil
import pytest
from click.testing import CliRunner

from slamhive.base.errors import Conflict, NotFound
from slamhive.cli import main
from slamhive.cli.waiting import evaluate_to_end
from slamhive.domain.sensors import SensorSetup
from slamhive.services.imports.request import ImportRequest
from slamhive.store import EvaluationState
from tests.services.imports.world import make_source
from tests.waiting import eventually

pytestmark = pytest.mark.integration

RUNS = 24
LEASE_S = 600


@pytest.fixture
def runs(hive, tmp_path):
    source = make_source(tmp_path / "source", ("alpha", "beta"), trials=RUNS // 4)
    request = ImportRequest(source, sensors={"": SensorSetup.STEREO})
    return hive.imports.carry_out(request, lambda _done, _total: None).run_ids


def states(hive):
    return {
        state: count for state, count in hive.store.read(lambda t: t.evaluations.counts_by_state()).items() if count
    }


def test_all_are_queued_at_once_and_none_twice(hive, runs):
    service = hive.evaluations
    assert service.unevaluated() == runs
    first = service.queue(runs)
    assert service.queue(list(reversed(runs)) + runs[:1]) is not None
    assert sorted(service.queue(runs)) == sorted(first)
    assert states(hive) == {EvaluationState.QUEUED: RUNS}
    assert service.unevaluated() == []
    assert service.still_open(first) == set(first)
    assert service.unsettled(runs) == runs


def test_nothing_is_queued_if_one_run_cannot_be(hive, runs):
    with pytest.raises(NotFound, match="unknown run 999"):
        hive.evaluations.queue([*runs, 999])
    hive.store.write(lambda t: t.database.exec_driver_sql("update runs set state='failed' where id=1"))
    with pytest.raises(Conflict, match="run 1 is failed"):
        hive.evaluations.queue(runs)
    assert states(hive) == {}


def test_failures_are_told_with_their_reasons_and_the_others_are_evaluated(hive, runs):
    hive.runs.folder(runs[0]).trajectory.write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n3 0 0 0 0 0 0 1\n")
    hive.runs.folder(runs[1]).trajectory.unlink()
    called = CliRunner().invoke(main, ["evaluate", "--all-unevaluated", "--json"])
    assert called.exit_code == 1
    assert f"run {runs[0]} cannot be evaluated: estimate and ground truth do not overlap in time" in called.stderr
    assert f"run {runs[1]} cannot be evaluated: there is no estimate" in called.stderr
    shown = json.loads(called.stdout)
    assert sum(entry["evaluation_reason"] is None for entry in shown) == RUNS - 2
    assert states(hive) == {EvaluationState.SUCCEEDED: RUNS - 2, EvaluationState.FAILED: 2}


def test_a_query_chooses_what_is_evaluated(hive, runs):
    called = CliRunner().invoke(main, ["evaluate", "--where", "algorithm = alpha and dataset ~ *2", "--json"])
    assert called.exit_code == 0, called.stderr
    shown = json.loads(called.stdout)
    assert {(entry["algorithm"], entry["dataset"]) for entry in shown} == {("alpha", "seq2")}
    assert len(shown) == RUNS // 4
    assert len(hive.evaluations.unevaluated()) == len(runs) - RUNS // 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--where", "algoritm = alpha"], "algorithm"),
        (["--where", "state = failed and dataset = seq1"], "no such run succeeded"),
        (["--where", "dataset = seq1", "--all-unevaluated"], "name the runs to evaluate"),
        (["1", "--where", "dataset = seq1"], "name the runs to evaluate"),
    ],
)
@pytest.mark.usefixtures("runs")
def test_queries_that_choose_nothing_are_explained(arguments, message):
    called = CliRunner().invoke(main, ["evaluate", *arguments])
    assert message in called.stderr
    assert "Traceback" not in called.stderr


def test_none_is_lost_when_the_command_is_killed(hive, runs, monkeypatch):
    """SIGKILL in the middle; the same command goes on at once, without waiting for the lease of the dead.

    The engine that the killed command had started ends with it: nobody would end it in time.
    """
    monkeypatch.setenv("SLAMHIVE_LEASE_S", str(LEASE_S))
    command = [sys.executable, "-m", "slamhive", "evaluate", "--all-unevaluated"]
    killed = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + 60
    while states(hive).get(EvaluationState.RUNNING, 0) == 0 or not engines(hive):
        assert time.monotonic() < deadline
        assert killed.poll() is None
        time.sleep(0.02)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.wait()
    eventually(lambda: not engines(hive), "the end of the engine")
    assert len(list(hive.settings.data.glob(".evaluation-*"))) == 1
    left = states(hive)
    assert sum(left.values()) == RUNS
    assert left.get(EvaluationState.SUCCEEDED, 0) < RUNS
    began = time.monotonic()
    assert CliRunner().invoke(main, ["evaluate", "--all-unevaluated"]).exit_code == 0
    assert time.monotonic() - began < LEASE_S / 2
    assert states(hive) == {EvaluationState.SUCCEEDED: RUNS}
    assert all(hive.runs.get(run_id).metrics["ate.rmse"] > 0 for run_id in runs)
    assert list(hive.settings.data.glob(".evaluation-*")) == []
    again = CliRunner().invoke(main, ["evaluate", "--where", "executor = imported", "--align", "sim3"])
    assert f"for {RUNS} runs; to change that: the same command with --current" in again.stderr, (
        "not a line of all numbers"
    )


def engines(hive):
    """Processes that evaluate for this installation."""
    scratch = str(hive.settings.data / ".evaluation-")
    return [
        process.pid
        for process in psutil.process_iter(["cmdline"])
        if any(part.startswith(scratch) for part in process.info["cmdline"] or ())
    ]


def test_more_than_a_part_at_a_time_is_worked_off(hive, runs, monkeypatch):
    monkeypatch.setattr("slamhive.cli.waiting.PART", 7)
    service = hive.evaluations
    ended = evaluate_to_end(service, service.queue(runs))
    assert [entry.run_id for entry in ended] == [entry.run_id for entry in service.records([e.id for e in ended])]
    assert all(entry.reason is None for entry in ended)
