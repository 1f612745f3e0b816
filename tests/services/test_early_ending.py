"""Runs that end early by their stop rules, each with its own reason, whatever happens to the worker."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable
from typing import Any

import pytest

from slamhive.documents.limits import StopWhen
from slamhive.documents.submission import Submission
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Exited, Running
from slamhive.run_folder.outcome import UNSEEN
from slamhive.services.configurations import unwatchable
from slamhive.services.worker.collecting import STOP_RULE, STOPPED_BECAUSE
from slamhive.services.worker.driver import RunDriver
from slamhive.services.worker.run_in_hand import DriverContext
from slamhive.store import Lease, RunRecord
from tests.services.fake_executor import FakeExecutor, write_trajectory
from tests.services.killed_worker import kill_at_each_step
from tests.services.test_worker import finish, hive, submit
from tests.services.test_worker_recovery import processes_of

pytestmark = [pytest.mark.integration, pytest.mark.timeout(900)]

__all__ = ["hive"]

LOST = StopWhen(lost_tracking_s=0.3)


def saying(**progress: float) -> Callable[[RunSpec], None]:
    """A start of an algorithm that says this of its progress."""

    def on_start(spec: RunSpec) -> None:
        result = spec.output("result").destination
        (result / "progress.json").write_text(json.dumps(progress))

    return on_start


@pytest.mark.parametrize(
    ("rules", "said", "reason", "words"),
    [
        (StopWhen(lost_tracking_s=5), {"untracked_s": 5.2}, FailureReason.LOST_TRACKING, "no pose for 5.2 s"),
        (StopWhen(time_s=0.05), {}, FailureReason.TIME_BUDGET, "stop_when allows time_s 0.05"),
    ],
)
def test_a_broken_rule_stops_the_run_and_is_written_down(hive, rules, said, reason, words):
    executor = FakeExecutor([Running()], saying(**said))
    run = finish(hive, executor, stop_when=rules)
    assert (run.state, run.reason, executor.stopped) == (RunState.FAILED, reason, 1)
    assert words in run.detail
    record = hive.runs.record(run.id)
    assert record[STOPPED_BECAUSE] == "stop_when"
    assert record[STOP_RULE] == {"reason": reason.value, "detail": run.detail}
    assert [event.why for event in hive.runs.events(run.id)][-2:] == ["ended early", run.detail]


@pytest.mark.parametrize("said", [{"untracked_s": 4.9}, {"untracked_s": -1}, {"untracked_s": None}, {}])
def test_a_run_that_keeps_to_its_rules_goes_on(hive, said):
    def start(spec: RunSpec) -> None:
        saying(**said)(spec)
        write_trajectory()(spec)

    executor = FakeExecutor([Running(), Running(), Exited(0)], start)
    run = finish(hive, executor, stop_when=StopWhen(lost_tracking_s=5, time_s=60))
    assert run.state is RunState.SUCCEEDED
    assert (UNSEEN in run.detail) is (said.get("untracked_s") is None or said["untracked_s"] < 0)


def test_a_run_that_multiplies_is_killed_without_being_asked(hive):
    executor = FakeExecutor([Running(), Running(process_limit=True)])
    run = finish(hive, executor)
    assert (run.state, run.reason, executor.graces_s) == (RunState.FAILED, FailureReason.PROCESS_LIMIT, [0.0])
    assert "limit of 512 processes and threads" in run.detail
    assert hive.runs.record(run.id)[STOPPED_BECAUSE] == "process_limit"
    assert [event.why for event in hive.runs.events(run.id)][-2:] == ["limit of processes reached", run.detail]


def test_a_result_that_is_complete_is_not_ended_early(hive):
    def start(spec: RunSpec) -> None:
        saying(untracked_s=99.0)(spec)
        write_trajectory()(spec)
        hive.runs.folder(spec.run_id).finished.touch()

    run = finish(hive, FakeExecutor([Running(), Running(), Exited(0)], start), stop_when=LOST)
    assert run.state is RunState.SUCCEEDED


class Killed(BaseException):
    """The worker is gone."""


@pytest.mark.parametrize("exit_code", [137, 143])
def test_a_run_that_a_signal_ended_while_no_worker_watched_is_lost(hive, exit_code):
    """As by the shutdown of a machine: first of the worker, then of its containers."""
    executor: Any = FakeExecutor([Exited(exit_code)], write_trajectory())
    run_id = submit(hive, executor)

    def die(handle):
        raise Killed

    executor.poll, poll = die, executor.poll
    with pytest.raises(Killed):
        drive(hive, run_id)
    hive.store.write(lambda t: t.queue.release_all("worker"))
    executor.poll = poll
    hive.worker().run(until_idle=True)
    run = hive.runs.get(run_id)
    assert (run.state, run.reason) == (RunState.FAILED, FailureReason.LOST)
    assert run.detail == f"it was ended while no worker watched, as when a machine goes down (exit code {exit_code})"


def test_what_was_written_down_before_the_worker_died_stands(hive):
    """The next worker stops the run for it, although the algorithm has found its way again."""
    executor: Any = FakeExecutor([Running()], saying(untracked_s=9.0))
    run_id = submit(hive, executor, stop_when=LOST)

    def die(handle, grace_s):
        raise Killed

    executor.stop, stop = die, executor.stop
    with pytest.raises(Killed):
        drive(hive, run_id)
    hive.store.write(lambda t: t.queue.release_all("worker"))
    assert hive.runs.record(run_id)[STOPPED_BECAUSE] == "stop_when"
    assert hive.runs.get(run_id).state is RunState.RUNNING

    executor.stop = stop
    (hive.runs.folder(run_id).progress).write_text('{"untracked_s": 0.0}')
    hive.worker().run(until_idle=True)
    run = hive.runs.get(run_id)
    assert (run.state, run.reason, executor.stopped) == (RunState.FAILED, FailureReason.LOST_TRACKING, 1)
    assert "no pose for 9.0 s" in run.detail


def drive(hive, run_id):
    """In this thread, as the worker ``worker`` would."""
    context = DriverContext(
        settings=hive.settings,
        store=hive.store,
        catalogue=hive.catalogue,
        executors=hive.executors.get,
        owner="worker",
        stopping=threading.Event(),
        still_held=lambda _run_id: True,
        cancel_requested=lambda _run_id: False,
        protocol_of=hive.evaluations.protocol_of,
        variants=hive.variants,
    )
    run = hive.store.write(lambda t: t.queue.claim(Lease("worker", context.now(), 60), only=[run_id]))
    RunDriver(context, run, None).drive()


def test_a_memory_budget_ends_a_real_process(hive):
    (run,) = hive.runs.submit(
        Submission(
            "tiny", "track", {"behaviour": "hungry", "seconds": 30}, stop_when=StopWhen(memory_mb=100), evaluate=False
        )
    )
    hive.worker().run(until_idle=True)
    after = hive.runs.get(run.id)
    assert (after.state, after.reason) == (RunState.FAILED, FailureReason.MEMORY_BUDGET)
    (used_mb,) = map(float, re.findall(r"used ([\d.]+) MB", after.detail))
    assert 100 < used_mb < 300
    assert after.metrics["duration"] < 15
    assert processes_of(hive) == []


def test_a_configuration_is_not_tried_again_once_it_has_failed_often_enough(hive):
    executor = FakeExecutor([Exited(3)])
    hive.executors.opened["process"] = executor
    rules = StopWhen(failures_of_configuration=2)
    runs = hive.runs.submit(Submission("tiny", "track", repeat=4, evaluate=False, stop_when=rules))
    other = hive.runs.submit(Submission("tiny", "track", {"seconds": 0.1}, evaluate=False, stop_when=rules))
    hive.worker().run(until_idle=True)
    reasons = [hive.runs.get(run.id).reason for run in (*runs, *other)]
    exited, skipped = FailureReason.NONZERO_EXIT, FailureReason.CONFIGURATION_FAILED
    assert reasons == [exited, exited, skipped, skipped, exited]
    assert len(executor.starts) == 3
    last = hive.runs.get(runs[3].id)
    assert last.state is RunState.FAILED
    assert "has failed 2 times, stop_when allows failures_of_configuration 2" in last.detail
    assert hive.runs.record(last.id)["reason"] == "configuration_failed"

    # Who asks again wants it tried again.
    again = hive.runs.retry(last.id)
    assert again.stop_when == rules
    hive.worker().run(until_idle=True)
    assert hive.runs.get(again.id).reason is exited


def test_a_user_is_told_of_rules_that_cannot_be_watched(hive):
    tiny = hive.catalogue.algorithm("tiny")
    assert (
        unwatchable(LOST, [tiny])
        == "lost_tracking_s has no effect on tiny, which does not say which frames are tracked"
    )
    assert unwatchable(StopWhen(time_s=1), [tiny]) is None


def test_the_rules_are_in_the_record_and_back_in_a_new_database(hive):
    rules = StopWhen(lost_tracking_s=0.5, failures_of_configuration=3)
    run_id = finish(hive, FakeExecutor([Exited(0)], write_trajectory()), stop_when=rules).id
    assert hive.runs.get(run_id).stop_when == rules
    assert hive.runs.record(run_id)["request"]["stop_when"] == {
        "lost_tracking_s": 0.5,
        "failures_of_configuration": 3,
    }


def test_killed_at_any_step_around_the_stop_the_reason_stays(hive):
    """A real process that stops tracking, a worker killed before and after each of its writes and calls."""

    def check(run: RunRecord, when: str) -> None:
        assert (run.state, run.reason) == (RunState.FAILED, FailureReason.LOST_TRACKING), when
        assert "no pose for" in (run.detail or "")
        assert hive.runs.record(run.id)["reason"] == "lost_tracking"

    asked = Submission("tiny", "track", {"behaviour": "lost", "seconds": 20}, evaluate=False, stop_when=LOST)
    kill_at_each_step(hive, asked, lambda count: range(count - 18, count + 1, 2), check)
    assert processes_of(hive) == []
