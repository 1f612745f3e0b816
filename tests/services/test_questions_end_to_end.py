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


def test_a_killed_command_goes_on_where_it_was(hive: Hive, tmp_path: Path):
    file = tmp_path / "behaviours.yaml"
    file.write_text(BEHAVIOURS)
    command = [sys.executable, "-m", "slamhive", "experiment", "decide", str(file)]
    first = subprocess.Popen(command, cwd=CHECKOUT, start_new_session=True)
    eventually(lambda: _ended(hive) > 0, "the end of a run")
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    before = hive.experiments.run_ids("behaviours")
    second = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert second.returncode == 0, second.stderr
    assert "behaviours: behaviour good is best in ATE RMSE" in second.stdout
    after = hive.experiments.run_ids("behaviours")
    assert after[: len(before)] == before
    assert len(after) == hive.questions.decision("behaviours").runs


def _ended(hive: Hive) -> int:
    names = [status.name for status in hive.experiments.list()]
    return hive.experiments.status("behaviours").ended if names else 0
