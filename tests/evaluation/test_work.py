"""The entry script's own behaviour: ended by a signal, and a worker that dies."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from slamhive.domain.protocol import Alignment, Protocol
from slamhive.evaluation import work
from slamhive.evaluation.job import EvaluationResult, EvaluationTask, job_to_json
from slamhive.evaluation.references import References
from slamhive.evaluation.work import run_task
from tests.waiting import PATIENCE_S, eventually

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent.parent


def make_tasks(folder: Path, count: int) -> list[EvaluationTask]:
    rows = "".join(f"{i / 10} {i % 7} {i % 5} {i / 9} 0 0 0 1\n" for i in range(2000))
    (folder / "traj.txt").write_text(rows)
    tasks = []
    for number in range(count):
        output = folder / f"out{number}"
        output.mkdir()
        path = folder / "traj.txt"
        tasks.append(EvaluationTask(f"t{number}", path, path, output, Protocol(Alignment.SE3)))
    return tasks


@pytest.mark.integration
def test_sigterm_ends_it_at_once_and_leaves_whole_files_only(tmp_path: Path) -> None:
    tasks = make_tasks(tmp_path, 200)
    job = tmp_path / "job.json"
    job.write_text(job_to_json(tasks))
    command = [sys.executable, str(ROOT / "evaluation" / "evaluate.py"), str(job)]
    environment = {"PATH": os.environ["PATH"], "TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, start_new_session=True) as process:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["reason"] is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=PATIENCE_S) == 128 + signal.SIGTERM
        eventually(lambda: is_gone(process.pid), "the end of its workers", patience_s=20)
    written = [task.output / "result.json" for task in tasks if (task.output / "result.json").exists()]
    assert 0 < len(written) < len(tasks)
    for path in written:
        assert json.loads(path.read_text())["reason"] is None


def is_gone(group: int) -> bool:
    """Whether no process of the group is left, not even one that waits for its parent to look at how it ended."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


def _dying(run: Callable[[EvaluationTask, References], EvaluationResult]) -> object:
    def run_or_die(task: EvaluationTask, references: References) -> EvaluationResult:
        if task.id == "t1":
            os.kill(os.getpid(), signal.SIGKILL)
        if task.id == "t2":
            raise ZeroDivisionError("a bug")
        return run(task, references)

    return run_or_die


@pytest.mark.integration
def test_a_task_that_kills_its_worker_costs_only_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work, "run_task", _dying(run_task))
    results = {result.id: result for result in work.evaluate_all(make_tasks(tmp_path, 6), 2)}
    assert set(results) == {f"t{i}" for i in range(6)}
    assert "died" in (results["t1"].reason or "")
    assert "a bug" in (results["t2"].reason or "")
    assert all(results[f"t{i}"].succeeded for i in (0, 3, 4, 5))


@pytest.mark.parametrize("arguments", [[], ["a", "b"], ["/does/not/exist.json"]])
def test_a_job_that_cannot_be_read_is_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGTERM)
    try:
        assert work.main(arguments, print) == 1
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err.count("\n") == 1
