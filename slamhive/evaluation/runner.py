"""Evaluates many runs with one start: prepares the job, starts it, and has a result for every task in the end."""

from __future__ import annotations

import logging
import stat
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from slamhive.base.errors import InvalidInput
from slamhive.base.files import write_aside
from slamhive.evaluation.job import (
    RESULT_FILE,
    EvaluationResult,
    EvaluationTask,
    failed_result,
    job_to_json,
    result_from_json,
)
from slamhive.evaluation.process import BatchMount, BatchStarter, EvaluationBatch, LineCallback, ProcessStarter

__all__ = ["EvaluationRunner", "ProcessStarter", "ResultCallback"]

logger = logging.getLogger(__name__)

ResultCallback = Callable[[EvaluationResult], None]

START_TIMEOUT_S = 120.0
TASK_TIMEOUT_S = 120.0
_INTERRUPTION_S = 0.5
_ENGINE_NOT_REACHED = "slamhive"
_REMEDIES = {
    "estimate": "start the run again",
    "ground truth": "put the dataset's file back, or import the dataset again",
}
_MAX_RESULT_BYTES = 1_000_000


class EvaluationRunner:
    """Runs evaluations through a starter.

    Args:
        starter: Runs the batch in a process or in a container.
    """

    def __init__(self, starter: BatchStarter) -> None:
        self._starter = starter

    def prepare(self, progress: LineCallback) -> None:
        """Make what evaluations need, in Docker their image, unless it exists. Raises SlamHiveError."""
        self._starter.prepare(progress)

    def run(
        self,
        tasks: Sequence[EvaluationTask],
        scratch: Path,
        on_result: ResultCallback,
        stopping: threading.Event | None = None,
        cores: tuple[int, ...] | None = None,
    ) -> list[EvaluationResult]:
        """Evaluate ``tasks``; one result for each, in the same order.

        A task without a result when the batch ends fails, and its reason says how the batch ended. If ``stopping`` is
        set, unfinished tasks are left out instead, since they can be evaluated later.

        Args:
            tasks: With different ids and existing output folders; paths of this machine.
            scratch: An empty folder for the job file and other temporary files.
            on_result: Called once for every result, as soon as it is known, in the caller's thread.
            stopping: Set by another thread to end early.
            cores: The numbers of the cores to evaluate on, None for all.

        Raises:
            Unavailable: The batch cannot be started at all.
        """
        stopping = stopping or threading.Event()
        collected = _Collected(tasks, on_result)
        ready = []
        for task in tasks:
            problem = _input_problem(task)
            if problem is None:
                ready.append(task)
            else:
                collected.add(failed_result(task, problem, _ENGINE_NOT_REACHED))
        if ready:
            job_path = scratch / "job.json"
            inside, mounts = _place(ready, job_path, isolated=self._starter.isolated)
            write_aside(job_path, job_to_json(inside))
            batch = EvaluationBatch(
                job=mounts[0].target,
                mounts=mounts,
                scratch=scratch,
                timeout_s=START_TIMEOUT_S + TASK_TIMEOUT_S * len(ready),
                cores=cores,
            )
            how_it_ended = self._starter.run_batch(batch, collected.add_line, stopping)
            collected.take_files(ready)
            without = [task for task in ready if task.id not in collected.results]
            # A signal to all processes of a systemd unit may reach the evaluation before it reaches us.
            if without and not stopping.wait(_INTERRUPTION_S):
                reason = f"evaluation ended early: {how_it_ended or 'no result was written'}"
                for task in without:
                    collected.add(failed_result(task, reason, _ENGINE_NOT_REACHED))
        return [collected.results[task.id] for task in tasks if task.id in collected.results]


class _Collected:
    """Results by task id; ``on_result`` gets each of them once."""

    def __init__(self, tasks: Sequence[EvaluationTask], on_result: ResultCallback) -> None:
        self.results: dict[str, EvaluationResult] = {}
        self._fingerprints = {task.id: task.protocol.fingerprint for task in tasks}
        self._on_result = on_result

    def add(self, result: EvaluationResult) -> None:
        if result.id in self.results or self._fingerprints.get(result.id) != result.fingerprint:
            return
        self.results[result.id] = result
        self._on_result(result)

    def add_line(self, line: str) -> None:
        try:
            result = result_from_json(line)
        except InvalidInput:
            logger.info("evaluation: %s", line.rstrip())
            return
        self.add(result)

    def take_files(self, tasks: Sequence[EvaluationTask]) -> None:
        """Add results that were written although their line did not arrive."""
        for task in tasks:
            if task.id in self.results:
                continue
            try:
                with (task.output / RESULT_FILE).open(encoding="utf-8") as stream:
                    result = result_from_json(stream.read(_MAX_RESULT_BYTES))
            except (OSError, ValueError, InvalidInput):
                continue
            if result.id == task.id:
                self.add(result)


def _input_problem(task: EvaluationTask) -> str | None:
    for name, path in (("estimate", task.estimate), ("ground truth", task.reference)):
        if path is None:
            continue
        try:
            mode = path.lstat().st_mode if name == "estimate" else path.stat().st_mode
        except FileNotFoundError:
            return f"there is no {name}: {path} does not exist; {_REMEDIES[name]}"
        except OSError as error:
            return f"the {name} {path} cannot be read: {error.strerror}; {_REMEDIES[name]}"
        if not stat.S_ISREG(mode):
            return f"the {name} {path} is not a regular file; {_REMEDIES[name]}"
    return None


def _place(
    tasks: Sequence[EvaluationTask], job_path: Path, *, isolated: bool
) -> tuple[list[EvaluationTask], tuple[BatchMount, ...]]:
    """The tasks with the paths that the batch sees, and its mounts; the job file is the first."""
    places: dict[Path, BatchMount] = {}

    def place(path: Path, target: str, *, read_only: bool = True) -> Path:
        path = path.absolute()
        if path not in places:
            places[path] = BatchMount(path, target if isolated else str(path), read_only)
        return Path(places[path].target)

    place(job_path, "/slamhive/job.json")
    inside = [
        replace(
            task,
            estimate=place(task.estimate, f"/slamhive/estimates/{number}/{task.estimate.name}"),
            reference=None
            if task.reference is None
            else place(task.reference.resolve(), f"/slamhive/references/{number}/{task.reference.name}"),
            output=place(task.output, f"/slamhive/outputs/{number}", read_only=False),
            files={
                name: place(path, f"/slamhive/files/{number}/{name}/{path.name}") for name, path in task.files.items()
            },
        )
        for number, task in enumerate(tasks)
    ]
    return inside, tuple(places.values())
