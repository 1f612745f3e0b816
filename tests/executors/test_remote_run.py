"""Complete runs on an agent that shares no files with the controller; the executor comes from an installed package."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from slamhive.documents.submission import Submission
from slamhive.domain.run import RunState
from slamhive.executors.base import ExecutorContext
from slamhive.executors.registry import installation_id
from slamhive.services.hive import Hive
from slamhive.store import RunRecord
from tests.executors.plugins import Agent
from tests.services.conftest import hive
from tests.services.killed_worker import check_whole, kill_at_each_step
from tests.services.working import started_times, working
from tests.waiting import PATIENCE_S, eventually

# A worker is started and killed some thirty times; on a busy machine that takes minutes.
pytestmark = [pytest.mark.integration, pytest.mark.timeout(1200)]

__all__ = ["hive"]

CHECKOUT = Path(__file__).resolve().parents[2]


@pytest.fixture
def far(hive: Hive, agent: Agent, plugins, plugin_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Hive:
    """An installation with the agent; commands find the executor by its entry point."""
    monkeypatch.setenv("SLAMHIVE_EXECUTOR", "remote")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(CHECKOUT), str(plugin_folder))))
    data = hive.settings.data
    context = ExecutorContext(data, hive.catalogue.project_root, installation_id(data))
    hive.executors.opened["remote"] = plugins["remote"](context)
    return hive


def submit(hive: Hive, **fields) -> int:
    parameters = fields.pop("parameters", {"seconds": 0.05})
    return hive.runs.submit(Submission("tiny", "track", parameters, executor="remote", **fields))[0].id


def command(*arguments: str) -> str:
    ended = subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, cwd=CHECKOUT, check=False
    )
    assert ended.returncode in (0, -signal.SIGKILL), ended.stderr
    return ended.stdout


def runs_of(agent: Agent) -> list[str]:
    return [path.name for path in agent.root.glob("runs/*/*")]


def test_a_run_and_its_evaluation(far, agent):
    assert "agent remote" in command("-m", "slamhive", "doctor", "--all")
    # This behaviour writes its progress again and again, so each sample sees CPU time.
    run_id = submit(far, parameters={"seconds": 1.5, "behaviour": "lost"})
    command("-m", "slamhive", "worker", "--until-idle")
    run = far.runs.get(run_id)
    assert (run.state, run.poses, run.executor) == (RunState.SUCCEEDED, 30, "remote"), run.detail
    assert run.metrics["ate.rmse"] is not None
    assert run.metrics["cpu.mean"] > 0
    folder = far.runs.folder(run_id)
    assert "tiny says hello" in folder.log.read_text()
    assert len(folder.profiling.read_text().splitlines()) > 5
    assert "the run was on another machine" in folder.host.read_text()
    assert {"spec", "handle", "protections", "state"} <= folder.read_record().keys()
    assert runs_of(agent) == []


def test_the_log_can_be_read_and_the_run_cancelled_while_it_goes_on(far, agent):
    run_id = submit(far, parameters={"seconds": 50})
    with working(far):
        eventually(lambda: far.runs.get(run_id).state is RunState.RUNNING, "the run")
        eventually(lambda: "tiny says hello" in far.runs.log(run_id), "the log")
        far.runs.cancel(run_id)
        eventually(lambda: far.runs.get(run_id).state.ended, "the end")
    assert far.runs.get(run_id).state is RunState.CANCELLED
    assert started_times(far, run_id) == 1
    assert runs_of(agent) == []


def test_stop_rules_see_what_the_algorithm_writes_on_the_other_side(far):
    from slamhive.documents.limits import StopWhen  # noqa: PLC0415

    parameters = {"seconds": 50, "behaviour": "lost"}
    run_id = submit(far, parameters=parameters, stop_when=StopWhen(lost_tracking_s=1.0), evaluate=False)
    far.worker().run(until_idle=True)
    run = far.runs.get(run_id)
    assert (run.state, str(run.reason)) == (RunState.FAILED, "lost_tracking"), run.detail


def test_a_run_outlives_its_agent(far, agent):
    run_id = submit(far, parameters={"seconds": 4}, evaluate=False)
    with working(far):
        eventually(lambda: far.runs.get(run_id).state is RunState.RUNNING, "the run")
        agent.kill()
        agent.start()
        eventually(lambda: far.runs.get(run_id).state.ended, "the end")
    assert far.runs.get(run_id).state is RunState.SUCCEEDED, far.runs.get(run_id).detail
    assert started_times(far, run_id) == 1


def test_a_wrong_token_is_refused_in_words(far, monkeypatch):
    monkeypatch.setenv("REMOTE_TOKEN", "another")
    executor = type(far.executors.get("remote"))(far.executors.get("remote")._context)
    assert "refuses the token" in str(executor.unavailable_because())


def test_killed_at_any_step_the_run_ends_once_and_well(far, agent):
    """After each write and call. The test of the process executor kills before each."""

    def check(run: RunRecord, when: str) -> None:
        check_whole(far, run, when)
        assert runs_of(agent) == [], when

    asked = Submission("tiny", "track", {"seconds": 0.05}, executor="remote")
    kill_at_each_step(far, asked, lambda count: range(2, count + 1, 2), check)
