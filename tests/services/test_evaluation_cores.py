"""Evaluations keep to the cores of the slot that does them: others measure on theirs."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

import pytest

from slamhive.documents.submission import Submission
from slamhive.evaluation.process import EvaluationBatch, LineCallback
from slamhive.services.worker.worker import share_cores
from tests.services.fake_executor import FakeExecutor, write_trajectory
from tests.services.test_worker import hive

pytestmark = pytest.mark.integration

__all__ = ["hive"]


@dataclass
class Starter:
    """Notes the cores of each batch and evaluates nothing."""

    isolated: bool = False
    cores: list[tuple[int, ...] | None] = field(default_factory=list)

    def prepare(self, progress: LineCallback) -> None:
        pass

    def run_batch(self, batch: EvaluationBatch, on_line: LineCallback, stopping: threading.Event) -> str:
        self.cores.append(batch.cores)
        return "it is not evaluated here"


@pytest.mark.parametrize("slots", [1, 2])
def test_the_cores_of_the_slot_reach_the_batch(hive, monkeypatch, slots):
    starter = Starter()
    executor = FakeExecutor(on_start=write_trajectory(30))
    monkeypatch.setattr(executor, "evaluation_starter", lambda: starter)
    monkeypatch.setattr(hive, "settings", hive.settings.with_values({"worker_slots": slots}))
    hive.executors.opened["process"] = executor
    hive.runs.submit(Submission("tiny", "track"))
    hive.worker().run(until_idle=True)
    assert len(starter.cores) == 1
    assert starter.cores[0] in share_cores(slots)
