"""The worker in trouble: whatever goes wrong around one run ends that run with a reason, and never the worker."""

from __future__ import annotations

import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any, cast

import pytest

from slamhive.base.errors import Unavailable
from slamhive.documents.submission import Submission
from slamhive.domain.run import FailureReason, RunState
from slamhive.evaluation.runner import EvaluationRunner
from slamhive.executors.base import EngineUnavailable, ImageMissing
from slamhive.executors.status import Exited, RunHandle, Running
from slamhive.services.worker.holding import Heartbeat
from slamhive.services.worker.run_in_hand import HeldRuns
from slamhive.store import EvaluationState, Lease, Store, Transaction
from tests.services.fake_executor import FakeExecutor, write_trajectory
from tests.services.test_worker import finish, hive, submit
from tests.waiting import PATIENCE_S, eventually

pytestmark = pytest.mark.integration

__all__ = ["hive"]


def test_a_broken_record_ends_the_run_and_not_the_worker(hive):
    executor: Any = FakeExecutor([Running(), Exited(0)])
    executor.on_start = lambda spec: hive.runs.folder(spec.run_id).record.write_text("{")
    broken = submit(hive, executor)
    hive.worker().run(until_idle=True)
    after = hive.runs.get(broken)
    assert (after.state, after.reason) == (RunState.FAILED, FailureReason.START_ERROR)
    assert "run.json is not JSON that can be used" in after.detail
    assert finish(hive, FakeExecutor([Exited(0)], write_trajectory())).state is RunState.SUCCEEDED


def test_a_fault_of_ours_ends_the_run_and_not_the_worker(hive):
    executor: Any = FakeExecutor(start_error=ZeroDivisionError("oops"))
    bad = finish(hive, executor)
    assert bad.state is RunState.FAILED
    assert "internal error: ZeroDivisionError: oops" in bad.detail
    assert executor.discarded == [bad.uid]
    assert finish(hive, FakeExecutor([Exited(0)], write_trajectory())).state is RunState.SUCCEEDED


class FaultyOnce:
    """A store whose first write fails with an error that nobody expects."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.writes = 0

    def write(self, work: Callable[[Transaction], Any]) -> Any:
        self.writes += 1
        if self.writes == 1:
            raise ZeroDivisionError("oops")
        return self._store.write(work)

    def read(self, work: Callable[[Transaction], Any]) -> Any:
        return self._store.read(work)


def test_a_fault_of_the_heartbeat_does_not_end_it(hive):
    run_id = submit(hive, FakeExecutor())
    hive.store.write(lambda t: t.queue.claim(t.lease("me", 0.3)))
    (before,) = hive.store.read(lambda t: t.runs.get_many([run_id]))
    held, store, ends = HeldRuns(), cast("Any", FaultyOnce(hive.store)), threading.Event()
    held.add(run_id)
    thread = threading.Thread(target=Heartbeat(held, store, "me", lease_s=0.3, interval_s=0.01).beat, args=(ends,))
    thread.start()
    eventually(lambda: hive.runs.get(run_id).lease_expires_at > before.lease_expires_at, "a longer lease")
    ends.set()
    thread.join(PATIENCE_S)
    assert store.writes >= 2
    assert held.snapshot() == {run_id}


def test_a_disk_that_is_full_for_a_while_loses_nothing(hive):
    executor: Any = FakeExecutor([Exited(0)], write_trajectory())
    full = [OSError(28, "No space left on device"), OSError(28, "No space left on device")]
    build = executor.build

    def sometimes(package, progress):
        if full:
            raise full.pop()
        return build(package, progress)

    executor.build = sometimes
    assert finish(hive, executor).state is RunState.SUCCEEDED


@pytest.mark.parametrize("failing", ["remove", "plots"])
def test_what_fails_after_the_outcome_cannot_take_the_evaluation(hive, monkeypatch, failing):
    executor: Any = FakeExecutor([Exited(0)], write_trajectory(30))

    def refuse(*_arguments):
        raise EngineUnavailable("no engine") if failing == "remove" else Unavailable("disk full")

    if failing == "remove":
        executor.remove = refuse
    else:
        monkeypatch.setattr("slamhive.services.worker.collecting.write_plots", refuse)
    hive.executors.opened["process"] = executor
    (run,) = hive.runs.submit(Submission("tiny", "track"))
    hive.worker(only=[run.id]).run(until_idle=True)
    assert hive.runs.get(run.id).state is RunState.SUCCEEDED
    (evaluation,) = hive.evaluations.of_run(run.id)
    assert evaluation.state is EvaluationState.SUCCEEDED, evaluation.reason


def test_an_evaluation_image_that_does_not_build_fails_the_evaluation_with_the_reason(hive, monkeypatch):
    def refuse(self, *_arguments, **_keywords):
        raise ImageMissing("building slam-hive-evaluation:evo failed at Step 3")

    monkeypatch.setattr(EvaluationRunner, "run", refuse)
    hive.executors.opened["process"] = FakeExecutor([Exited(0)], write_trajectory(30))
    (run,) = hive.runs.submit(Submission("tiny", "track"))
    hive.worker().run(until_idle=True)
    (evaluation,) = hive.evaluations.of_run(run.id)
    assert evaluation.state is EvaluationState.FAILED
    assert "failed at Step 3" in evaluation.reason
    assert hive.runs.get(run.id).state is RunState.SUCCEEDED


def test_an_engine_that_came_back_is_not_blamed_later(hive):
    executor: Any = FakeExecutor([Running(), EngineUnavailable("a hiccup"), Running(), Exited(3)])
    run = finish(hive, executor)
    assert run.reason is FailureReason.NONZERO_EXIT


def test_an_unanswered_start_is_discarded_when_the_run_is_cancelled(hive):
    asked = threading.Event()
    executor: Any = FakeExecutor()

    def start(spec):
        asked.set()
        raise EngineUnavailable("no answer")

    executor.start = start
    run_id = submit(hive, executor)
    worker = hive.worker()
    thread = threading.Thread(target=worker.run, kwargs={"until_idle": True})
    thread.start()
    assert asked.wait(PATIENCE_S)
    hive.runs.cancel(run_id)
    thread.join(PATIENCE_S)
    assert hive.runs.get(run_id).state is RunState.CANCELLED
    assert executor.discarded == [hive.runs.get(run_id).uid]


def test_the_engine_knows_best_when_a_run_started(hive):
    began = datetime.now(UTC) - timedelta(seconds=5)
    executor: Any = FakeExecutor([Exited(0, ended_at=datetime.now(UTC))], write_trajectory())
    start = executor.start

    def start_earlier(spec):
        handle = start(spec)
        return RunHandle(handle.executor, {**handle.data, "started_at": began.isoformat()})

    executor.start = start_earlier
    run = finish(hive, executor)
    assert run.started_at == began
    assert 4 < run.metrics["duration"] < 10


def test_a_worker_that_lost_its_lease_leaves_the_folder_alone(hive):
    executor: Any = FakeExecutor([Running()], write_trajectory())
    run_id = submit(hive, executor)
    worker = hive.worker()
    thread = threading.Thread(target=worker.run)
    thread.start()
    eventually(lambda: hive.runs.record(run_id).get("state") == "running", "the run")
    eventually(lambda: hive.runs.get(run_id).state is RunState.RUNNING, "the run in the database")
    hive.store.write(lambda t: t.queue.release_all(worker.owner))
    now = datetime.now(UTC)
    hive.store.write(lambda t: t.queue.claim(Lease("another", now, 60)))
    before = hive.runs.folder(run_id).record.read_text()
    executor.statuses = [Exited(1)]
    threading.Event().wait(0.3)
    worker.stop()
    thread.join(PATIENCE_S)
    assert hive.runs.get(run_id).state is RunState.RUNNING
    assert hive.runs.get(run_id).lease_owner == "another"
    assert hive.runs.folder(run_id).record.read_text() == before
