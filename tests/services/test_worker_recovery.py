"""The worker is killed at every step of a run's life; the next one accounts for the run, and nothing runs twice."""

from __future__ import annotations

import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamhive.cli.main import main
from slamhive.documents.submission import Submission
from slamhive.domain.run import RunState
from slamhive.services.hive import Hive, open_hive
from tests.services.killed_worker import check_whole, kill_at_each_step
from tests.services.working import started_times
from tests.waiting import eventually

# A worker is started, killed and followed by another some thirty times; on a busy machine that takes minutes.
pytestmark = [pytest.mark.integration, pytest.mark.timeout(1200)]

CHECKOUT = Path(__file__).resolve().parents[2]


def processes_of(hive: Hive) -> list[str]:
    listing = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    return [line for line in listing.splitlines() if str(hive.settings.data) in line and "ps -eo" not in line]


def test_killed_at_any_step_the_run_ends_once_and_well(hive):
    """Before each write and call. The remote executor has a test that kills after each."""
    asked = Submission("tiny", "track", {"seconds": 0.3})  # long enough for samples, and so for plots
    kill_at_each_step(hive, asked, lambda count: range(1, count + 1, 2), partial(check_whole, hive))
    assert processes_of(hive) == []


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
