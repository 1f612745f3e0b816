"""A worker that is stopped while it makes what a run needs returns the run to the queue, and blames it for nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.documents.submission import Submission
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.base import ImageMissing, StartFailed
from slamhive.executors.process.executor import ProcessExecutor
from slamhive.services.hive import Hive
from slamhive.services.worker import worker as worker_module
from slamhive.services.worker.worker import Worker
from tests.services.working import started_times
from tests.waiting import PATIENCE_S, eventually

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[2]
SHORT = Submission("tiny", "track", {"seconds": 0.1}, evaluate=False)
PREPARE = """
import pathlib, sys, time
waits = pathlib.Path({waits!r})
if waits.exists():
    waits.with_name("begun").touch()
    print("installing", flush=True)
    try:
        time.sleep(120)
    except KeyboardInterrupt:
        print("ERROR: Operation cancelled by user")  # as pip does
        sys.exit(1)
"""


def _ctrl_c(worker: psutil.Process) -> None:
    """A terminal sends it to all processes of the foreground group."""
    os.killpg(worker.pid, signal.SIGINT)


def _unit_is_stopped(worker: psutil.Process) -> None:
    """systemd sends it to all processes of the unit, in any order."""
    for process in [*worker.children(recursive=True), worker]:
        process.send_signal(signal.SIGTERM)
        time.sleep(0.1)


def _asked(worker: psutil.Process) -> None:
    """As `slamhive serve` ends its worker."""
    worker.send_signal(signal.SIGTERM)


def test_a_run_that_is_cancelled_meanwhile_is_not_queued_again(hive: Hive, monkeypatch: pytest.MonkeyPatch) -> None:
    workers: list[Worker] = []

    def interrupted(*_: object) -> None:
        hive.runs.cancel(run.id)
        workers[0].stop()
        raise ImageMissing("interrupted")

    (run,) = hive.runs.submit(SHORT)
    workers.append(hive.worker())
    monkeypatch.setattr(worker_module, "CANCEL_CHECK_S", 60.0)  # no heartbeat tells the next worker in time
    with monkeypatch.context() as troubled:
        troubled.setattr(ProcessExecutor, "build", interrupted)
        workers[0].run()
    hive.worker().run(until_idle=True)
    assert hive.runs.get(run.id).state is RunState.CANCELLED


@pytest.mark.parametrize("interrupt", [_ctrl_c, _unit_is_stopped, _asked])
def test_an_interrupted_installation_returns_the_run_to_the_queue(
    hive: Hive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interrupt: Callable[[psutil.Process], None]
) -> None:
    monkeypatch.setenv("PIP_NO_COMPILE", "no")  # pip takes it as "compile: no", for which half of its time goes
    waits = tmp_path / "waits"
    waits.touch()
    package = hive.catalogue.algorithm("tiny").package.folder
    (package / "prepare.py").write_text(PREPARE.format(waits=str(waits)))
    (run,) = hive.runs.submit(SHORT)
    command = [sys.executable, "-m", "slamhive", "worker"]
    with subprocess.Popen(command, cwd=CHECKOUT, start_new_session=True, stderr=subprocess.PIPE) as worker:
        try:
            eventually((tmp_path / "begun").exists)
            known = psutil.Process(worker.pid)
            children = known.children(recursive=True)
            assert children
            began = time.monotonic()
            interrupt(known)
            _, errors = worker.communicate(timeout=PATIENCE_S)
            assert time.monotonic() - began < 15
        finally:
            worker.kill()
    assert worker.returncode == 0, errors.decode()
    assert psutil.wait_procs(children, timeout=PATIENCE_S)[1] == []
    queued = hive.runs.get(run.id)
    assert (queued.state, queued.reason) == (RunState.QUEUED, None), queued.detail
    assert hive.runs.events(run.id)[-1].why == "the worker was stopped while it prepared the run"
    waits.unlink()
    hive.worker().run(until_idle=True)
    assert hive.runs.get(run.id).state is RunState.SUCCEEDED
    assert started_times(hive, run.id) == 1


@pytest.mark.parametrize(
    ("step", "error", "left"),
    [
        ("build", ImageMissing("pip install failed with exit code -2"), RunState.QUEUED),
        ("build", InvalidInput("a variant cannot be made"), RunState.QUEUED),
        ("build", ZeroDivisionError("a library that was interrupted"), RunState.QUEUED),
        ("start", StartFailed("the supervisor process did not start"), RunState.STARTING),
        ("start", ImageMissing("the environment is gone"), RunState.STARTING),
    ],
)
def test_a_failure_just_before_the_worker_is_told_to_stop_is_not_the_runs(
    hive: Hive, monkeypatch: pytest.MonkeyPatch, step: str, error: Exception, left: RunState
) -> None:
    workers: list[Worker] = []

    def interrupted(*_: object) -> None:
        threading.Timer(0.1, workers[0].stop).start()
        raise error

    (run,) = hive.runs.submit(SHORT)
    workers.append(hive.worker())
    with monkeypatch.context() as troubled:
        troubled.setattr(ProcessExecutor, step, interrupted)
        workers[0].run()
    assert hive.runs.get(run.id).state is left
    hive.worker().run(until_idle=True)
    assert hive.runs.get(run.id).state is RunState.SUCCEEDED
    assert started_times(hive, run.id) == 1


def test_a_failure_that_nothing_explains_is_the_runs(hive: Hive, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise ImageMissing("pip install failed with exit code 1: no such version")

    monkeypatch.setattr(ProcessExecutor, "build", fails)
    (run,) = hive.runs.submit(SHORT)
    hive.worker().run(until_idle=True)
    assert hive.runs.get(run.id).reason is FailureReason.IMAGE_MISSING
