"""The worker is killed at every step of a run's life; the next one accounts for the run, and nothing runs twice."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamhive.cli.main import main
from slamhive.domain.run import RunState
from slamhive.schema.submission import Submission
from slamhive.services.evaluations.service import Evaluations
from slamhive.services.hive import Hive, open_hive
from tests.forking import Ended
from tests.services.killed_worker import killed_workers
from tests.waiting import eventually

# A worker is started, killed and followed by another some thirty times; on a busy machine that takes minutes.
pytestmark = [pytest.mark.integration, pytest.mark.timeout(1200)]

CHECKOUT = Path(__file__).resolve().parents[2]
MOST_STEPS = 200


def started_times(hive: Hive, run_id: int) -> int:
    return len((hive.runs.folder(run_id).result / "starts.txt").read_text().splitlines())


def processes_of(hive: Hive) -> list[str]:
    listing = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    return [line for line in listing.splitlines() if str(hive.settings.data) in line and "ps -eo" not in line]


def test_killed_at_any_step_the_run_ends_once_and_well(hive, monkeypatch):
    # Evaluating takes a second each time and has tests of its own; here it counts that each run is queued for it.
    monkeypatch.setattr(Evaluations, "work_once", lambda *_arguments, **_options: 0)
    (warm_up,) = hive.runs.submit(Submission("tiny", "track"))
    with killed_workers() as work:
        undisturbed = work(MOST_STEPS)
        assert undisturbed.returncode == 0, undisturbed.errors
        assert undisturbed.value > 20
        assert hive.runs.get(warm_up.id).state is RunState.SUCCEEDED
        # Before each write and call. The remote executor has a test that kills after each.
        for fatal_step in range(1, undisturbed.value + 1, 2):
            check_killed(hive, work, fatal_step)
    assert processes_of(hive) == []


def check_killed(hive: Hive, work: Callable[[int], Ended], fatal_step: int) -> None:
    (run,) = hive.runs.submit(Submission("tiny", "track", {"seconds": 0.05}))
    killed = work(fatal_step)
    assert killed.returncode in (-signal.SIGKILL, 0), killed.errors
    hive.worker().run(until_idle=True)
    after = hive.runs.get(run.id)
    assert after.state is RunState.SUCCEEDED, f"killed at step {fatal_step}: {after.state}, {after.detail}"
    assert after.poses == 30
    assert len(hive.evaluations.of_run(run.id)) == 1, f"killed at step {fatal_step}"
    assert started_times(hive, run.id) == 1, f"killed at step {fatal_step}"
    record = hive.runs.record(run.id)
    assert (record["state"], record["poses"]) == ("succeeded", 30)
    assert [event.to_state for event in hive.runs.events(run.id)][-1] is RunState.SUCCEEDED


def test_a_run_that_goes_on_while_no_worker_lives_is_adopted(hive):
    hive.executors.get("process").build(hive.catalogue.algorithm("tiny").package, lambda _line: None)
    (run,) = hive.runs.submit(Submission("tiny", "track", {"seconds": 4}, evaluate=False))
    worker = subprocess.Popen([sys.executable, "-m", "slamhive", "worker"], cwd=CHECKOUT)
    try:
        eventually(lambda: hive.runs.get(run.id).state is RunState.RUNNING, "the run")
    finally:
        worker.kill()
        worker.wait()
    hive.worker().run(until_idle=True)
    after = hive.runs.get(run.id)
    assert after.state is RunState.SUCCEEDED
    assert started_times(hive, run.id) == 1
    assert after.metrics["duration"] > 2.5


def test_a_lost_database_is_rebuilt_from_the_folders(hive):
    submitted = hive.runs.submit(Submission("tiny", "track", {"seconds": 0.05}, repeat=2))
    hive.runs.submit(Submission("tiny", "track", {"behaviour": "crash", "seconds": 0.05}))
    hive.worker().run(until_idle=True)
    before = [hive.runs.get(run_id) for run_id in (1, 2, 3)]
    assert before[0].metrics["ate.rmse"] is not None
    hive.close()
    for path in hive.settings.data.glob("slamhive.db*"):
        path.unlink()

    lost = CliRunner().invoke(main, ["runs"])
    assert lost.exit_code == 1
    assert "slamhive reindex" in lost.stderr
    filed = CliRunner().invoke(main, ["reindex"])
    assert "3 runs and 2 evaluations filed, 0 left out" in filed.stdout, filed.stderr

    again = open_hive()
    for old in before:
        new = again.runs.get(old.id)
        assert (new.uid, new.state, new.reason, new.poses) == (old.uid, old.state, old.reason, old.poses)
        assert new.parameters == old.parameters
        assert new.metrics == old.metrics
        assert new.protocol == old.protocol
        assert new.version == old.version
        assert new.host == old.host
    assert again.runs.submit(Submission("tiny", "track"))[0].id == max(run.id for run in submitted) + 2
    again.close()


def test_a_broken_folder_is_left_out_with_its_reason(hive):
    hive.runs.submit(Submission("tiny", "track", {"seconds": 0.05}, repeat=2, evaluate=False))
    hive.worker().run(until_idle=True)
    hive.runs.folder(1).record.write_text("{")
    shutil.copytree(hive.runs.folder(2).root, hive.settings.runs_folder / "9")
    filed = CliRunner().invoke(main, ["reindex"])
    assert filed.exit_code == 1
    assert "1 runs and 0 evaluations filed, 2 left out" in filed.stdout
    assert "runs/1: " in filed.stderr
    assert "folders must not be renamed" in filed.stderr
