"""What runs write: limited while they go on, tidied up however they end, whoever is killed meanwhile."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest

from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Exited, RunHandle, Running
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.untrusted import DiskLimits
from slamhive.services.runs.specification import disk_limit_bytes
from slamhive.services.worker.collecting import disk_limits, gather_evidence
from tests.services.fake_executor import FakeExecutor, write_trajectory
from tests.services.test_worker import finish, hive, submit
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.integration

__all__ = ["hive"]


def folder_of(spec: RunSpec) -> RunFolder:
    return RunFolder(spec.work.parent)


def leave_a_link(spec: RunSpec) -> None:
    folder_of(spec).trajectory.symlink_to("/etc/passwd")
    (folder_of(spec).work / "scratch").write_bytes(b"1")


def test_a_worker_killed_after_the_removal_is_followed_by_the_same_outcome(hive, monkeypatch):
    seen: list[bool] = []

    def once(folder: RunFolder, *arguments: Any, **options: Any) -> Any:
        seen.append(folder.trajectory.is_symlink())
        if len(seen) == 1:
            raise OSError(5, "as good as killed")
        return gather_evidence(folder, *arguments, **options)

    monkeypatch.setattr("slamhive.services.worker.collecting.gather_evidence", once)
    run = finish(hive, FakeExecutor([Exited(0)], leave_a_link))
    assert seen == [False, False]
    assert run.reason is FailureReason.MALFORMED_TRAJECTORY
    assert run.detail.startswith("traj.txt is a link")
    assert run.detail.endswith("; removed from its result: links (1)")
    assert hive.runs.record(run.id)["left"]["removed"] == {"links": 1}
    assert not hive.runs.folder(run.id).work.exists()


def test_a_cancelled_run_is_tidied_up(hive):
    started = threading.Event()

    def start(spec: RunSpec) -> None:
        leave_a_link(spec)
        started.set()

    run_id = submit(hive, FakeExecutor([Running()], start))
    thread = threading.Thread(target=hive.worker().run, kwargs={"until_idle": True})
    thread.start()
    assert started.wait(PATIENCE_S)
    hive.runs.cancel(run_id)
    thread.join(PATIENCE_S)
    assert hive.runs.get(run_id).state is RunState.CANCELLED
    assert list(hive.runs.folder(run_id).result.iterdir()) == []
    assert not hive.runs.folder(run_id).work.exists()


def test_scratch_space_that_a_killed_worker_left_goes_with_the_next(hive):
    ended = finish(hive, FakeExecutor([Exited(0)], write_trajectory()))
    left = hive.runs.folder(ended.id)
    left.create()
    (left.work / "more" / "deep").mkdir(parents=True)
    nobody = RunFolder(left.root.parent / "77")
    nobody.create()
    hive.worker().run(until_idle=True)
    assert not left.work.exists()
    assert left.trajectory.exists()
    assert nobody.work.exists()


def test_what_only_the_engine_sees_counts(hive):
    executor: Any = FakeExecutor([Running()], write_trajectory())
    graces: list[float] = []
    stop = executor.stop
    executor.hidden_bytes = lambda handle: 10**15

    def noted(handle: RunHandle, grace_s: float) -> None:
        graces.append(grace_s)
        stop(handle, grace_s)

    executor.stop = noted
    run = finish(hive, executor)
    assert run.reason is FailureReason.DISK_LIMIT
    assert "MB, as its executor counts" in run.detail
    assert graces == [0.0]


def test_files_are_counted_while_the_run_goes_on_and_at_its_end(hive):
    def start(spec: RunSpec) -> None:
        for number in range(101):
            (folder_of(spec).result / str(number)).touch()

    hive.settings = hive.settings.with_values({"run_files": 100})
    for statuses in ([Running()], [Exited(0)]):
        executor = FakeExecutor(list(statuses), start)
        run = finish(hive, executor)
        assert run.reason is FailureReason.DISK_LIMIT
        assert "more than 100 files and folders" in run.detail
        assert executor.stopped == (statuses == [Running()])
        assert list(hive.runs.folder(run.id).result.iterdir()) == []


def test_half_of_the_free_space_that_is_wanted_stays(hive, tmp_path: Path):
    settings = hive.settings.with_values({"run_disk_mb": 1})
    assert disk_limit_bytes(settings) == 1_000_000
    settings = settings.with_values({"run_disk_mb": 10**9, "min_free_disk_mb": 10**9})
    assert disk_limit_bytes(settings) == 0


def test_a_run_that_was_started_without_limits_has_none():
    assert disk_limits({"spec": {"limits": {"memory_bytes": 1}}}) == DiskLimits()
    assert disk_limits({}) == DiskLimits()
