"""The worker on an executor that does what the test says."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

import slamhive
from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, Forbidden, InvalidInput, NotFound, Unavailable
from slamhive.documents.run import RunDocument
from slamhive.documents.submission import Submission
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.base import EngineUnavailable, ImageMissing, StartFailed
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Exited, Gone, RunHandle, Running
from slamhive.executors.transfer import read_places
from slamhive.run_folder.folder import RunFolder
from slamhive.services.hive import Hive, check_indexed, open_hive
from slamhive.services.reindex import reindex
from slamhive.services.worker import worker as worker_module
from slamhive.services.worker.run_in_hand import RunInHand
from slamhive.store import Lease, LeaseLost, RunRecord
from tests.services.fake_executor import FakeExecutor, write_trajectory
from tests.services.tiny_project import environment, make_dataset, make_project
from tests.waiting import PATIENCE_S, eventually

pytestmark = pytest.mark.integration


@pytest.fixture
def hive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sqlite_template: Path) -> Iterator[Hive]:
    make_project(tmp_path / "project")
    make_dataset(tmp_path / "data")
    shutil.copy(sqlite_template, tmp_path / "data" / "slamhive.db")
    extra = {"poll_interval_s": "0.01", "stop_grace_s": "0.1"}
    for key, value in environment(tmp_path / "project", tmp_path / "data", **extra).items():
        monkeypatch.setenv(key, value)
    monkeypatch.setattr(worker_module, "TROUBLE_PAUSE_S", 0.02)
    monkeypatch.setattr(worker_module, "IDLE_PAUSE_S", 0.01)
    monkeypatch.setattr(worker_module, "CANCEL_CHECK_S", 0.02)
    opened = open_hive()
    yield opened
    opened.close()


def submit(hive: Hive, executor: FakeExecutor, **changes: Any) -> int:
    hive.executors.opened["process"] = executor
    return hive.runs.submit(Submission("tiny", "track", evaluate=False, **changes))[0].id


def finish(hive: Hive, executor: FakeExecutor, **changes: Any):
    run_id = submit(hive, executor, **changes)
    hive.worker().run(until_idle=True)
    return hive.runs.get(run_id)


def test_a_good_run_goes_through_all_states(hive):
    executor = FakeExecutor([Running(), Running(), Exited(0)], write_trajectory(3))
    run = finish(hive, executor)
    assert (run.state, run.reason, run.poses) == (RunState.SUCCEEDED, None, 3)
    moves = [event.to_state for event in hive.runs.events(run.id)]
    assert moves == ["queued", "preparing", "starting", "running", "collecting", "succeeded"]
    assert executor.removed == 1
    assert hive.runs.record(run.id)["protections"]["does_not_hold"] == {"cgroup": "it is a fake"}
    assert hive.runs.log(run.id) == "hello\n"


def test_an_idle_worker_begins_when_a_run_is_submitted(hive, monkeypatch):
    monkeypatch.setattr(worker_module, "LONGEST_IDLE_PAUSE_S", 10 * PATIENCE_S)
    executor = FakeExecutor([Exited(0)], write_trajectory(3))
    worker = hive.worker()
    idle = threading.Event()
    wait = hive.store.wait_for_commit

    def noted(*arguments: Any) -> None:
        idle.set()
        wait(*arguments)

    monkeypatch.setattr(hive.store, "wait_for_commit", noted)
    thread = threading.Thread(target=worker.run)
    thread.start()
    try:
        assert idle.wait(PATIENCE_S)
        run_id = submit(hive, executor)
        eventually(lambda: hive.runs.get(run_id).state is RunState.SUCCEEDED)
    finally:
        worker.stop()
        thread.join()


def test_each_trajectory_that_a_run_leaves_is_to_be_evaluated(hive):
    path = hive.catalogue.project_root / "algorithms" / "tiny" / "algorithm.yaml"
    role = "    trajectory_role: points"
    path.write_text(path.read_text().replace(role, f"{role}\n    trajectory: final"))

    def leave_two(spec: RunSpec) -> None:
        write_trajectory(3)(spec)
        result = spec.output("result").destination
        (result / "traj.live.txt").write_text((result / "traj.txt").read_text())

    hive.executors.opened["process"] = FakeExecutor(on_start=leave_two)
    (run,) = hive.runs.submit(Submission("tiny", "track"))
    hive.worker().run(until_idle=True)
    assert hive.runs.get(run.id).trajectory == "final"
    assert hive.runs.record(run.id)["trajectory"] == "final"
    ended = hive.evaluations.of_run(run.id)
    assert [(entry.protocol.trajectory, entry.reason) for entry in ended] == [(None, None), ("live", None)]
    reindex(hive, lambda done, total: None)
    assert hive.runs.get(run.id).trajectory == "final"


@pytest.mark.parametrize(
    ("executor", "reason", "detail"),
    [
        (FakeExecutor(build_error=ImageMissing("pip failed")), FailureReason.IMAGE_MISSING, "pip failed"),
        (FakeExecutor(start_error=StartFailed("no cgroup")), FailureReason.START_ERROR, "no cgroup"),
        (FakeExecutor([Exited(3)], write_trajectory()), FailureReason.NONZERO_EXIT, "3"),
        (FakeExecutor([Exited(137, out_of_memory=True)]), FailureReason.OUT_OF_MEMORY, "memory"),
        (FakeExecutor([Gone("container is gone")]), FailureReason.LOST, "container is gone"),
        (FakeExecutor([Exited(0)]), FailureReason.NO_TRAJECTORY, "traj.txt"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_each_way_to_fail_has_its_reason(hive, executor, reason, detail):
    run = finish(hive, executor)
    assert (run.state, run.reason) == (RunState.FAILED, reason)
    assert detail in run.detail
    assert hive.runs.record(run.id)["reason"] == reason.value
    assert RunDocument.of(run).content["metrics"].get("ate.rmse") is None


class VanishedExecutor(FakeExecutor):
    """Its engine takes a run for alive whose machine is gone."""

    def stop(self, handle: RunHandle, grace_s: float) -> None:
        self.statuses = [Gone("nobody could record its end")]


def test_a_run_that_is_found_to_be_gone_at_its_time_limit_is_lost_and_not_late(hive):
    run = finish(hive, VanishedExecutor(statuses=[Running()]), timeout_s=1)
    assert (run.state, run.reason) == (RunState.FAILED, FailureReason.LOST)
    assert run.detail == "nobody could record its end"


def test_a_stuck_algorithm_ends_by_its_timeout(hive):
    executor = FakeExecutor([Running()])
    run = finish(hive, executor, timeout_s=1)
    assert (run.state, run.reason) == (RunState.FAILED, FailureReason.TIMEOUT)
    assert executor.stopped == 1


def test_a_run_that_was_not_heard_of_since_is_not_late(hive):
    """Its node may have ended it long ago, while the worker was away; its results are on their way."""
    heard_at = utc_now()
    executor = FakeExecutor([*[Running(as_of=heard_at)] * 150, Exited(0)], write_trajectory(3))
    run = finish(hive, executor, timeout_s=1)
    assert run.state is RunState.SUCCEEDED
    assert executor.stopped == 0


def test_a_dataset_that_vanishes_fails_the_run_with_a_reason(hive):
    run_id = submit(hive, FakeExecutor())
    hive.catalogue.remove_dataset("track")
    hive.worker().run(until_idle=True)
    run = hive.runs.get(run_id)
    assert run.reason is FailureReason.PREPROCESS_ERROR
    assert "unknown dataset 'track'" in run.detail


def test_an_engine_that_is_away_loses_nothing(hive):
    away = [EngineUnavailable("no engine") for _ in range(3)]
    executor = FakeExecutor([Running(), *away, Running(), Exited(0)], write_trajectory())
    run = finish(hive, executor)
    assert run.state is RunState.SUCCEEDED
    assert len(executor.starts) == 1


def test_a_run_that_its_engine_took_along_is_lost_not_blamed(hive):
    executor = FakeExecutor([Running(), EngineUnavailable("no engine"), Exited(137)])
    run = finish(hive, executor)
    assert (run.state, run.reason) == (RunState.FAILED, FailureReason.LOST)
    assert "the engine went away at" in run.detail


class TakesAlong(FakeExecutor):
    """Its runs end with their engine."""

    capabilities = replace(FakeExecutor.capabilities, takes_runs_along=True)


@pytest.mark.parametrize(
    ("kind", "finished", "reason"),
    [
        (TakesAlong, False, FailureReason.LOST),
        (TakesAlong, True, None),
        (FakeExecutor, False, None),
    ],
)
def test_a_run_that_exits_with_0_while_its_engine_is_away(hive, kind, finished, reason):
    """Such a run may have been asked to end, unless it has said that nothing more will come."""

    def start(spec: RunSpec) -> None:
        write_trajectory()(spec)
        if finished:
            hive.runs.folder(spec.run_id).finished.touch()

    run = finish(hive, kind([EngineUnavailable("no engine"), Exited(0)], start))
    assert run.reason == reason
    assert ("the engine went away at" in run.detail) is (reason is not None)


@pytest.mark.parametrize(("later_s", "reason"), [(-1, FailureReason.LOST), (60, FailureReason.NONZERO_EXIT)])
def test_an_engine_that_dies_before_it_answers_the_start(hive, later_s, reason):
    """The run may have started, and then ended with its engine; one that starts afterwards ends by itself."""
    answers: list[Exception] = [EngineUnavailable("no engine")]

    def start_unheard(_spec: RunSpec) -> None:
        if answers:
            raise answers.pop()

    ended = Exited(143, started_at=utc_now() + timedelta(seconds=later_s))
    run = finish(hive, FakeExecutor([ended], start_unheard))
    assert (run.state, run.reason) == (RunState.FAILED, reason)
    assert hive.executors.opened["process"].starts[1].run_id == run.id


def test_a_queued_run_is_cancelled_at_once(hive):
    run_id = submit(hive, FakeExecutor())
    assert hive.runs.cancel(run_id).state is RunState.CANCELLED
    hive.worker().run(until_idle=True)
    assert hive.runs.get(run_id).state is RunState.CANCELLED
    with pytest.raises(Conflict, match="has ended already"):
        hive.runs.cancel(run_id)


def test_an_active_run_is_cancelled_by_its_worker(hive):
    started = threading.Event()
    executor = FakeExecutor([Running()], lambda spec: started.set())
    run_id = submit(hive, executor)
    worker = hive.worker()
    thread = threading.Thread(target=worker.run, kwargs={"until_idle": True})
    thread.start()
    assert started.wait(PATIENCE_S)
    hive.runs.cancel(run_id)
    thread.join(PATIENCE_S)
    assert hive.runs.get(run_id).state is RunState.CANCELLED
    assert (executor.stopped, executor.removed) == (1, 1)


def test_a_stopping_worker_leaves_the_run_to_the_next(hive):
    started = threading.Event()

    def start(spec):
        write_trajectory()(spec)
        started.set()

    executor = FakeExecutor([Running()], start)
    run_id = submit(hive, executor)
    worker = hive.worker()
    thread = threading.Thread(target=worker.run)
    thread.start()
    assert started.wait(PATIENCE_S)
    eventually(lambda: hive.runs.get(run_id).state is RunState.RUNNING, "the run")
    worker.stop()
    thread.join(PATIENCE_S)
    assert hive.runs.get(run_id).state is RunState.RUNNING
    assert executor.stopped == 0
    assert hive.runs.log(run_id) == "hello\n"
    assert not hive.runs.folder(run_id).log.exists(), "whoever looks at a log writes into no run folder"
    executor.statuses = [Exited(0)]
    hive.worker().run(until_idle=True)
    assert hive.runs.get(run_id).state is RunState.SUCCEEDED
    assert len(executor.starts) == 1


def test_only_one_worker_runs_on_a_machine(hive, monkeypatch):
    executor = FakeExecutor([Running()])
    submit(hive, executor)
    worker = hive.worker()
    thread = threading.Thread(target=worker.run)
    thread.start()
    eventually(hive.worker_alive, "the worker")
    with pytest.raises(Conflict, match="already running on this machine"):
        hive.worker().run()
    worker.stop()
    thread.join(PATIENCE_S)


def test_retry_makes_a_new_run_of_the_same_configuration(hive):
    failed = finish(hive, FakeExecutor([Exited(1)]))
    again = hive.runs.retry(failed.id)
    assert (again.retry_of, again.configuration_id, again.state) == (failed.id, failed.configuration_id, "queued")
    with pytest.raises(Conflict, match="only a run that has ended"):
        hive.runs.retry(again.id)


def test_repeats_share_a_configuration_and_differ_in_seed(hive):
    runs = hive.runs.submit(Submission("tiny", "track", repeat=3, seed=5))
    assert {run.configuration_id for run in runs} == {runs[0].configuration_id}
    assert [run.seed for run in runs] == [5, 6, 7]


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"algorithm": "tinny"}, NotFound, "unknown algorithm 'tinny'; did you mean 'tiny'"),
        ({"dataset": "trak"}, NotFound, "unknown dataset 'trak'; did you mean 'track'"),
        ({"parameters": {"second": 1}}, NotFound, "did you mean 'seconds'"),
        ({"parameters": {"seconds": "soon"}}, InvalidInput, "parameter seconds='soon'"),
        ({"parameters": {"seconds": 61}}, InvalidInput, "0 to 60 s"),
        ({"repeat": 0}, InvalidInput, "repeat 0"),
        ({"repeat": 3, "seed": 2**31 - 2}, InvalidInput, "seed 2147483648 is not allowed; use 0 to 2147483647"),
        ({"playback_mode": "fast"}, InvalidInput, "use one of realtime, sequential"),
        ({"playback_rate": 0.0}, InvalidInput, "playback rate"),
        ({"executor": "podman"}, NotFound, "unknown executor 'podman'"),
        ({"alignment": "magic"}, InvalidInput, "alignment 'magic'"),
        ({"timeout_s": float("nan")}, InvalidInput, "time limit"),
    ],
)
def test_a_wrong_request_stores_nothing(hive, changes, error, message):
    request = {"algorithm": "tiny", "dataset": "track", **changes}
    with pytest.raises(error, match=message):
        hive.runs.submit(Submission(**request))
    assert sum(hive.runs.counts().values()) == 0


def test_view_only_changes_nothing(tmp_path, monkeypatch, hive):
    run_id = submit(hive, FakeExecutor())
    monkeypatch.setenv("SLAMHIVE_MODE", "view-only")
    reader = open_hive()
    for change in (
        lambda: reader.runs.submit(Submission("tiny", "track")),
        lambda: reader.runs.cancel(run_id),
        lambda: reader.runs.retry(run_id),
        lambda: reader.evaluations.queue(None),
        reader.worker,
    ):
        with pytest.raises(Forbidden, match="view-only"):
            change()
    assert reader.runs.get(run_id).state is RunState.QUEUED
    reader.close()


@pytest.mark.parametrize("mode", ["cluster", "cloud"])
def test_a_cluster_runs_nothing_on_its_own_machine(hive, monkeypatch, mode):
    monkeypatch.setenv("SLAMHIVE_MODE", mode)
    cluster = open_hive()
    for executor in ("docker", "process"):
        with pytest.raises(Unavailable, match=f"the executor {executor} runs algorithms on this machine only"):
            cluster.runs.submit(Submission("tiny", "track", executor=executor))
    with pytest.raises(Unavailable, match=r"choose one of: .*kubernetes"):
        cluster.runs.submit(Submission("tiny", "track"))  # the setting is process
    assert cluster.runs.counts() == hive.runs.counts()
    cluster.close()


def test_a_full_disk_starts_nothing(hive, monkeypatch):
    monkeypatch.setenv("SLAMHIVE_MIN_FREE_DISK_MB", "999999999")
    strict = open_hive()
    with pytest.raises(Unavailable, match="MB free, 999999999 MB are required"):
        strict.runs.submit(Submission("tiny", "track"))
    strict.close()


def test_run_folders_without_rows_ask_for_a_reindex(hive):
    (hive.settings.runs_folder / "1").mkdir()
    with pytest.raises(Conflict, match="slamhive reindex"):
        check_indexed(hive)


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Every ``run.json`` that is written, as it was."""
    found: list[dict[str, Any]] = []
    write = RunFolder.write_record

    def recording(folder: RunFolder, record: dict[str, Any]) -> None:
        found.append(json.loads(RunFolder.record_text(record)))
        write(folder, record)

    monkeypatch.setattr(RunFolder, "write_record", recording)
    return found


def test_each_move_writes_the_record_once(hive, written):
    run = finish(hive, FakeExecutor([Exited(0)], write_trajectory(3)))
    assert run.state is RunState.SUCCEEDED
    moves = [record for record in written if record["state"] != "collecting" or "left" not in record]
    assert [record["state"] for record in moves] == ["preparing", "starting", "running", "collecting", "succeeded"]
    assert len(written) == len(moves) + 1, "beside the moves, what the run left is written before it is removed"
    for record in written:
        assert record["events"][-1]["to"] == record["state"], "state and event are written together"
    assert [event["to"] for event in written[-1]["events"]] == [event.to_state for event in hive.runs.events(run.id)]


@pytest.mark.parametrize(
    ("executor", "states"),
    [
        (FakeExecutor(build_error=ImageMissing("pip failed")), ["preparing", "failed"]),
        (FakeExecutor(start_error=StartFailed("no cgroup")), ["preparing", "starting", "failed"]),
    ],
    ids=["build", "start"],
)
def test_a_failure_writes_the_record_once(hive, written, executor, states):
    run = finish(hive, executor)
    assert [record["state"] for record in written] == states
    assert (written[-1]["reason"], written[-1]["detail"]) == (run.reason.value, run.detail)


@pytest.fixture
def hand(hive: Hive) -> RunInHand:
    """A run that this worker holds, with a record."""
    submit(hive, FakeExecutor())
    worker = hive.worker()
    run = hive.store.write(lambda t: t.queue.claim(Lease(worker.owner, utc_now(), 60.0)))
    assert run is not None
    held = RunInHand(worker._context, run, None)
    held.folder.create()
    held.begin()
    return held


def taken(hive: Hive) -> RunRecord | None:
    """The run, taken by another worker after its lease has expired; None if it cannot be taken."""
    later = utc_now() + timedelta(hours=1)
    return hive.store.write(lambda t: t.queue.claim(Lease("there", later, 60.0)))


@pytest.mark.parametrize(
    "write",
    [
        lambda hand: hand.begin(),
        lambda hand: hand.save({"kernel_totals": {"ram.charged_max": 1.0}}),
        lambda hand: hand.move(RunState.STARTING, "too late", record={}),
        lambda hand: hand.fail(FailureReason.START_ERROR, "too late"),
        lambda hand: hand.check_owner(),
    ],
    ids=["begin", "save", "move", "fail", "check"],
)
def test_a_worker_that_lost_its_run_leaves_the_record_alone(hive, hand, written, write):
    run = taken(hive)
    assert run is not None
    with pytest.raises(LeaseLost):
        write(hand)
    assert written == []
    assert hive.runs.get(run.id).state is RunState.PREPARING


def test_a_run_is_put_back_even_if_its_record_cannot_be_read(hive, hand, written):
    hand.folder.record.write_text("{")
    assert hand.put_back("waits")
    assert hive.runs.get(hand.run.id).state is RunState.QUEUED
    assert [record["state"] for record in written] == ["queued"]


def test_a_run_is_not_put_back_if_it_is_cancelled_or_started(hive, hand, written):
    hive.runs.cancel(hand.run.id)
    assert not hand.put_back("waits")
    assert hive.runs.get(hand.run.id).state is RunState.PREPARING
    hand.move(RunState.STARTING, "prepared", record={})
    assert not hand.put_back("waits")
    assert [record["state"] for record in written] == ["starting"]


def test_a_run_that_another_worker_has_is_not_put_back(hive, hand, written):
    assert taken(hive) is not None
    with pytest.raises(LeaseLost):
        hand.put_back("waits")
    assert written == []


@pytest.mark.parametrize(
    "write",
    [lambda hand: hand.save({"note": 1}), lambda hand: hand.move(RunState.STARTING, "prepared", record={})],
    ids=["save", "move"],
)
def test_no_worker_takes_a_run_whose_record_is_being_written(hive, hand, monkeypatch, write):
    """Otherwise a slow writer would overwrite what the new holder has written since."""
    order: list[str] = []
    write_record = RunFolder.write_record

    def take() -> None:
        assert taken(hive) is not None
        order.append("taken")

    other = threading.Thread(target=take)

    def slowly(folder: RunFolder, record: dict[str, Any]) -> None:
        other.start()
        other.join(0.3)
        write_record(folder, record)
        order.append("written")

    monkeypatch.setattr(RunFolder, "write_record", slowly)
    write(hand)
    other.join()
    assert order == ["written", "taken"]


def test_only_an_image_that_somebody_else_made_gets_a_copy_of_the_scripts(hive):
    folder = hive.catalogue.package("tiny").folder
    (folder / "Dockerfile").unlink()
    theirs, ours = FakeExecutor(), FakeExecutor()
    finish(hive, theirs)
    yaml = folder / "algorithm.yaml"
    yaml.write_text(f"image: standard\n{yaml.read_text()}")
    finish(hive, ours)
    assert [entry.own_copy for entry in theirs.starts[0].inputs if entry.name == "slamhive"] == [True]
    assert "slamhive" not in {entry.name for entry in ours.starts[0].inputs}


def test_an_engine_is_asked_for_nothing_from_the_folder_of_the_program(hive):
    """A worker in a container has its program there, and the engine mounts what the host has under that path."""
    engine = FakeExecutor()
    finish(hive, engine)
    program = Path(slamhive.__file__).resolve().parent
    script = next(entry for entry in engine.starts[0].inputs if entry.name == "rosbag_play.py")
    assert script.source.is_relative_to(program)
    assert script.own_copy
    mounted = read_places(engine.starts[0])
    assert [str(source) for source in mounted.values() if source.is_relative_to(program)] == []
