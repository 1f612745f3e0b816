"""Experiments that choose their runs, with real runs: by a worker, and after a kill."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from slamhive.domain.question import QuestionAnswer
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.services.reindex import reindex
from tests.services.test_experiment_recovery import lose_database, silent
from tests.waiting import eventually

pytestmark = [pytest.mark.integration, pytest.mark.timeout(300)]

CHECKOUT = Path(__file__).resolve().parents[2]
BEHAVIOURS = """\
name: behaviours
algorithms: tiny
datasets: track
parameters: {behaviour: good | crash, seconds: 0}
decide: {difference: 1 cm, budget: 40 runs, worst: 1 m}
executor: process
"""


def test_a_worker_takes_an_experiment_to_its_answer(hive: Hive):
    hive.experiments.start(ExperimentSource(BEHAVIOURS))
    hive.worker().run(until_idle=True)
    found = hive.questions.decision("behaviours")
    assert (found.answer, found.candidates[0].label) == (QuestionAnswer.BEST, "behaviour good")
    assert found.runs < 20
    assert hive.experiments.status("behaviours").conclusion == found.words


def killed_at_the_end_of_a_run(hive: Hive, folder: Path, verb: str, text: str) -> list[str]:
    """The command that was killed, with everything it had started, when its first run had ended."""
    file = folder / "behaviours.yaml"
    file.write_text(text)
    command = [sys.executable, "-m", "slamhive", "experiment", verb, str(file)]
    first = subprocess.Popen(command, cwd=CHECKOUT, start_new_session=True)
    eventually(lambda: _ended(hive) > 0, "the end of a run")
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    return command


def test_a_killed_command_goes_on_where_it_was(hive: Hive, tmp_path: Path):
    command = killed_at_the_end_of_a_run(hive, tmp_path, "decide", BEHAVIOURS)
    before = hive.experiments.run_ids("behaviours")
    second = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert second.returncode == 0, second.stderr
    assert "behaviours: behaviour good is best in ATE RMSE" in second.stdout
    after = hive.experiments.run_ids("behaviours")
    assert after[: len(before)] == before
    assert len(after) == hive.questions.decision("behaviours").runs


LOOKS = """\
name: behaviours
algorithms: tiny
datasets: track
parameters: {behaviour: good | crash, seconds: 0 | 1}
optimise: {metric: ram.max, budget: 4 runs, first_look: 2 s, keep: 50%, within: 50%}
evaluate: false
executor: process
"""


@pytest.mark.timeout(600)
def test_first_looks_survive_kills_and_a_lost_database_without_their_recording(hive: Hive, tmp_path: Path):
    command = killed_at_the_end_of_a_run(hive, tmp_path, "optimise", LOOKS)
    before = [run_id for run_id in hive.experiments.run_ids("behaviours") if hive.runs.get(run_id).variant]
    assert len(before) == 4, "one first look at each combination"
    second = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert second.returncode in {0, 3}, second.stderr
    found = hive.questions.search("behaviours")
    assert found.words in second.stdout
    runs = [hive.runs.get(run_id) for run_id in hive.experiments.run_ids("behaviours")]
    assert [run.id for run in runs if run.variant] == before
    looked = [(run.cell, run.seed) for run in runs if run.variant]
    assert len(looked) == len(set(looked)) == found.first_looks == 4
    assert len(runs) - 4 == found.runs <= 4
    cells = [(cell.number, cell.values) for cell in hive.experiments.report("behaviours")]

    # The folders of the runs are enough to restore it, although the recording is gone.
    hive.catalogue.dataset("track").bag_path.unlink()
    again = lose_database(hive)
    try:
        report = reindex(again, silent)
        assert (report.skipped, report.queued) == ([], 0)
        assert again.questions.search("behaviours") == found
        assert [(cell.number, cell.values) for cell in again.experiments.report("behaviours")] == cells
    finally:
        again.close()


def _ended(hive: Hive) -> int:
    names = [status.name for status in hive.experiments.list()]
    return hive.experiments.status("behaviours").ended if names else 0
