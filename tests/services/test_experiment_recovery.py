"""What an experiment survives: a start that is killed, and a database that is lost."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from slamhive.documents.plain import ConfigurationStanding
from slamhive.domain.verdict import Outcome
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive, open_hive
from slamhive.services.reindex import reindex

pytestmark = pytest.mark.integration

MANY = """\
name: many
algorithms: tiny
datasets: track
parameters: {seconds: 'lin(0, 1, 30)', behaviour: good | crash}
seeds: 1 | 2
"""

KILLED_START = """
import os, signal, sys
from slamhive.services.experiments import previewing, starting
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import open_hive
from slamhive.store import Store
starting.CHUNK = 10
write, left = Store.write, [int(sys.argv[2])]
def dying(self, work):
    left[0] -= 1
    if left[0] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return write(self, work)
Store.write = dying
open_hive().experiments.start(ExperimentSource(open(sys.argv[1]).read()))
"""

SOME = "name: some\nalgorithms: tiny\ndatasets: track\nparameters: {behaviour: good | crash, seconds: 0 | 0.01}\n"


@pytest.mark.parametrize("writes", [1, 3, 9])
def test_a_killed_start_is_completed_by_the_same_file(hive: Hive, tmp_path: Path, writes: int) -> None:
    path = tmp_path / "many.yaml"
    path.write_text(MANY)
    command = [sys.executable, "-c", KILLED_START, str(path), str(writes)]
    assert subprocess.run(command, env=os.environ, timeout=120, check=False).returncode == -signal.SIGKILL
    found = {status.name: status for status in hive.experiments.list()}
    if writes > 1:
        assert found["many"].state is ConfigurationStanding.STORING
        assert sum(found["many"].counts.values()) == 120 - found["many"].missing < 120
    status = hive.experiments.start(ExperimentSource(MANY))
    assert (status.state, status.cells, status.runs, status.missing) == (ConfigurationStanding.ACTIVE, 60, 120, 0)
    ids = hive.experiments.run_ids("many")
    runs = hive.store.read(lambda t: t.runs.get_many(ids))
    assert len(runs) == len({(run.cell, run.seed) for run in runs}) == 120
    assert [cell.number for cell in hive.experiments.report("many")] == list(range(1, 61))


def lose_database(hive: Hive) -> Hive:
    """Without a ledger, as in data roots of older versions; with one, see ``test_unbreakable``."""
    hive.close()
    for path in hive.settings.data.glob("slamhive.db*"):
        path.unlink()
    shutil.rmtree(hive.settings.ledger_folder)
    return open_hive()


def silent(_done: int, _total: int) -> None:
    pass


def test_a_lost_database_is_rebuilt_with_what_waited(hive: Hive) -> None:
    hive.experiments.start(ExperimentSource(SOME))
    first = hive.experiments.run_ids("some")[0]
    hive.worker(only=[first]).run(until_idle=True)
    hive.experiments.pause("some")
    before = list(hive.experiments.report("some"))
    again = lose_database(hive)
    try:
        report = reindex(again, silent)
        assert (report.runs, report.experiments, report.queued, report.skipped) == (1, 1, 3, [])
        status = again.experiments.status("some")
        assert status.state is ConfigurationStanding.PAUSED
        assert (status.counts[Outcome.GOOD], status.counts[Outcome.QUEUED]) == (1, 3)
        after = list(again.experiments.report("some"))
        assert [(cell.name, cell.values, cell.counts) for cell in after] == [
            (cell.name, cell.values, cell.counts) for cell in before
        ]
        again.worker().run(until_idle=True)
        assert again.experiments.status("some").counts[Outcome.QUEUED] == 3, "paused as before"
        again.experiments.resume("some")
        again.worker().run(until_idle=True)
        assert again.experiments.status("some").state is ConfigurationStanding.FINISHED
    finally:
        again.close()


def test_a_cancelled_experiment_stays_cancelled(hive: Hive) -> None:
    hive.experiments.start(ExperimentSource(SOME))
    hive.experiments.cancel("some")
    again = lose_database(hive)
    try:
        assert reindex(again, silent).queued == 0
        assert again.experiments.status("some").state is ConfigurationStanding.CANCELLED
        assert again.experiments.run_ids("some") == ()
    finally:
        again.close()


def test_an_algorithm_that_is_gone_is_told_and_results_stay(hive: Hive) -> None:
    hive.experiments.start(ExperimentSource(SOME))
    hive.worker(only=hive.experiments.run_ids("some")[:1]).run(until_idle=True)
    (hive.catalogue.project_root / "algorithms" / "tiny" / "algorithm.yaml").unlink()
    again = lose_database(hive)
    try:
        report = reindex(again, silent)
        ((folder, reason),) = report.skipped
        assert folder.name == "some"
        assert "some line 2: algorithm 'tiny'" in reason
        assert "slamhive algorithm import" in reason
        assert again.experiments.status("some").counts[Outcome.GOOD] == 1
    finally:
        again.close()
