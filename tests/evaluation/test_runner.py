"""The runner with starters that do what batches do at their worst, and with the real process."""

import os
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.domain.protocol import Alignment, Protocol
from slamhive.evaluation.job import EvaluationResult, EvaluationTask, job_from_json, result_to_json
from slamhive.evaluation.process import EvaluationBatch
from slamhive.evaluation.runner import EvaluationRunner, ProcessStarter

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent.parent


def make_tasks(folder: Path, count: int) -> list[EvaluationTask]:
    truth = folder / "groundtruth.txt"
    rows = "".join(f"{i / 10} {i % 7} {i % 5} {i / 9} 0 0 0 1\n" for i in range(40))
    truth.write_text(rows)
    tasks = []
    for number in range(count):
        output = folder / f"out{number}"
        output.mkdir()
        estimate = folder / f"traj{number}.txt"
        estimate.write_text(rows)
        tasks.append(EvaluationTask(f"t{number}", estimate, truth, output, Protocol(Alignment.SE3)))
    return tasks


def good(task: EvaluationTask) -> EvaluationResult:
    return EvaluationResult(task.id, task.protocol.fingerprint, None, {"ate.rmse": 1.0}, 2, 2, "test")


class Scripted:
    """Reports the results of the first tasks, then ends as told."""

    def __init__(self, done: int, ending: str | None, *, isolated: bool = False, written: int = 0) -> None:
        self.isolated, self.done, self.ending, self.written = isolated, done, ending, written
        self.batch: EvaluationBatch | None = None
        self.tasks: tuple[EvaluationTask, ...] = ()

    def prepare(self, progress: Callable[[str], None]) -> None:
        progress("nothing to prepare")

    def run_batch(
        self, batch: EvaluationBatch, on_line: Callable[[str], None], stopping: threading.Event
    ) -> str | None:
        self.batch = batch
        self.tasks = job_from_json(batch.mounts[0].source.read_text())
        on_line("something a library printed\n")
        for task in self.tasks[: self.done]:
            on_line(result_to_json(good(task)) + "\n")
        for task in self.tasks[self.done : self.done + self.written]:
            (task.output / "result.json").write_text(result_to_json(good(task)))
        return self.ending


def run(starter: object, tasks: list[EvaluationTask], folder: Path) -> tuple[list[EvaluationResult], list[str]]:
    scratch = folder / "scratch"
    scratch.mkdir()
    told: list[str] = []
    results = EvaluationRunner(starter).run(tasks, scratch, lambda result: told.append(result.id))  # type: ignore[arg-type]
    return results, told


def test_every_task_is_accounted_for_when_the_batch_dies(tmp_path: Path) -> None:
    tasks = make_tasks(tmp_path, 5)
    tasks[1].estimate.unlink()
    results, told = run(Scripted(done=2, ending="it was killed by SIGKILL", written=1), tasks, tmp_path)
    assert [result.id for result in results] == [f"t{i}" for i in range(5)]
    assert sorted(told) == [f"t{i}" for i in range(5)]
    assert [result.reason is None for result in results] == [True, False, True, True, False]
    assert results[1].reason is not None
    assert "there is no estimate" in results[1].reason
    assert results[1].reason.endswith("; start the run again")
    assert results[4].reason == "evaluation ended early: it was killed by SIGKILL"


def test_a_missing_ground_truth_says_what_to_do(tmp_path: Path) -> None:
    tasks = make_tasks(tmp_path, 1)
    assert tasks[0].reference is not None
    tasks[0].reference.unlink()
    results, _ = run(Scripted(done=0, ending=None), tasks, tmp_path)
    assert results[0].reason is not None
    assert results[0].reason.endswith("put the dataset's file back, or import the dataset again")


def test_an_earlier_result_on_disk_is_not_taken_for_this_one(tmp_path: Path) -> None:
    tasks = make_tasks(tmp_path, 1)
    other = EvaluationResult("another", "x", None, {}, 1, 1, "test")
    (tasks[0].output / "result.json").write_text(result_to_json(other))
    results, _ = run(Scripted(done=0, ending=None), tasks, tmp_path)
    assert results[0].reason == "evaluation ended early: no result was written"


def test_what_is_stopped_is_left_out(tmp_path: Path) -> None:
    tasks = make_tasks(tmp_path, 3)
    stopping = threading.Event()
    stopping.set()
    (tmp_path / "scratch").mkdir()
    runner = EvaluationRunner(Scripted(done=1, ending="it was stopped"))
    results = runner.run(tasks, tmp_path / "scratch", lambda _result: None, stopping)
    assert [result.id for result in results] == ["t0"]


def test_a_container_sees_mounts_only_outputs_writable(tmp_path: Path) -> None:
    starter = Scripted(done=2, ending=None, isolated=True)
    run(starter, make_tasks(tmp_path, 2), tmp_path)
    assert starter.batch is not None
    assert starter.batch.job == "/slamhive/job.json"
    targets = {mount.target: mount for mount in starter.batch.mounts}
    assert len(targets) == len(starter.batch.mounts) == 1 + 1 + 2 + 2
    for task in starter.tasks:
        assert str(task.estimate) in targets
        assert str(task.reference) in targets
        assert not targets[str(task.output)].read_only
    assert [mount.target for mount in starter.batch.mounts if not mount.read_only] == [
        "/slamhive/outputs/0",
        "/slamhive/outputs/1",
    ]


def test_a_container_sees_further_files_read_only_and_shared_ones_once(tmp_path: Path) -> None:
    starter = Scripted(done=2, ending=None, isolated=True)
    reference_map = tmp_path / "reference_map.pcd"
    tasks = [
        replace(task, files={"map": tmp_path / str(number) / "Map.pcd", "reference_map": reference_map})
        for number, task in enumerate(make_tasks(tmp_path, 2))
    ]
    run(starter, tasks, tmp_path)
    assert starter.batch is not None
    targets = {mount.target: mount for mount in starter.batch.mounts}
    assert len(targets) == len(starter.batch.mounts) == 1 + 1 + 2 + 2 + 2 + 1
    first, second = (task.files for task in starter.tasks)
    assert first["reference_map"] == second["reference_map"]
    for path, source in ((second["map"], tmp_path / "1" / "Map.pcd"), (second["reference_map"], reference_map)):
        assert targets[str(path)].source == source
        assert targets[str(path)].read_only


def test_cores_are_passed_on_to_the_batch(tmp_path: Path) -> None:
    starter = Scripted(done=1, ending=None)
    (tmp_path / "scratch").mkdir()
    EvaluationRunner(starter).run(make_tasks(tmp_path, 1), tmp_path / "scratch", lambda _result: None, cores=(1, 3))
    assert starter.batch is not None
    assert starter.batch.cores == (1, 3)


@pytest.mark.integration
def test_the_real_process_keeps_to_its_cores(tmp_path: Path) -> None:
    (tmp_path / "evaluation").mkdir()
    (tmp_path / "evaluation" / "evaluate.py").write_text("import os\nprint(sorted(os.sched_getaffinity(0)))\n")
    usable = sorted(os.sched_getaffinity(0))
    starter = ProcessStarter(tmp_path)
    said: list[str] = []
    for cores in ((usable[-1],), None):
        starter.run_batch(EvaluationBatch("job.json", (), tmp_path, 30.0, cores), said.append, threading.Event())
    assert said == [f"[{usable[-1]}]\n", f"{usable}\n"]
    assert sorted(os.sched_getaffinity(0)) == usable


@pytest.mark.integration
def test_the_real_process_goes_on_after_a_broken_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    tasks = make_tasks(tmp_path, 3)
    tasks[1].estimate.write_bytes(b"\x00\x01")
    results, told = run(ProcessStarter(ROOT), tasks, tmp_path)
    assert [result.succeeded for result in results] == [True, False, True]
    assert "not a text file" in (results[1].reason or "")
    assert sorted(told) == ["t0", "t1", "t2"]
    assert list(home.iterdir()) == []


@pytest.mark.integration
def test_the_real_process_can_be_stopped(tmp_path: Path) -> None:
    stopping = threading.Event()
    stopping.set()
    (tmp_path / "scratch").mkdir()
    runner = EvaluationRunner(ProcessStarter(ROOT))
    assert runner.run(make_tasks(tmp_path, 2), tmp_path / "scratch", lambda _result: None, stopping) == []


@pytest.mark.integration
def test_a_script_that_fails_says_its_last_words(tmp_path: Path) -> None:
    (tmp_path / "evaluation").mkdir()
    (tmp_path / "evaluation" / "evaluate.py").write_text("raise SystemExit('no evo here')")
    results, _ = run(ProcessStarter(tmp_path), make_tasks(tmp_path, 1), tmp_path)
    assert results[0].reason == "evaluation ended early: exit code 1: no evo here"
