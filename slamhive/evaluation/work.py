"""Evaluates every task of a job on all cores, whatever single tasks do."""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import FrameType

from slamhive.errors import InvalidInput, SlamHiveError
from slamhive.evaluation.artefacts import load_libraries, run_task
from slamhive.evaluation.batch import PARENT_VARIABLE
from slamhive.evaluation.engine import ENGINE
from slamhive.evaluation.job import EvaluationResult, EvaluationTask, failed_result, job_from_json, result_to_json
from slamhive.evaluation.references import References

logger = logging.getLogger(__name__)

ENDED_BY_SIGTERM = 128 + signal.SIGTERM
_REAP_TIMEOUT_S = 1.0
_PR_SET_PDEATHSIG = 1
"""Of <linux/prctl.h>."""

_references = References()
"""Read by this process; the workers are forked from it and inherit them."""


def main(arguments: Sequence[str], emit: Callable[[str], None]) -> int:
    """Evaluate the job file in ``arguments``; ``emit`` gets one line of JSON for each finished task.

    Returns the exit code: 0 if every task has a result, good or bad; 1, with one line on stderr, if the job file cannot
    be read.
    """
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s")
    signal.signal(signal.SIGTERM, _end)
    _end_with_parent()
    try:
        tasks = _read_job(arguments)
    except SlamHiveError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    for result in evaluate_all(tasks, _usable_cores()):
        emit(result_to_json(result))
    return 0


def evaluate_all(tasks: Sequence[EvaluationTask], workers: int) -> Iterator[EvaluationResult]:
    """The results of the tasks as they finish. Ground truths are read once, before the workers are forked.

    A task that kills its worker, for example by using too much memory, breaks the pool. The unfinished tasks are then
    tried again one by one, and only the one that kills its worker again is given up.
    """
    _references.preload(tasks)
    load_libraries(tasks)
    unfinished = yield from _in_pool(tasks, min(workers, len(tasks)))
    for task in unfinished:
        again = yield from _in_pool([task], 1)
        if again:
            yield failed_result(task, "the evaluation process died, probably out of memory", ENGINE)


def _in_pool(tasks: Sequence[EvaluationTask], workers: int) -> Generator[EvaluationResult, None, list[EvaluationTask]]:
    """Results of ``tasks`` as they finish; returns the tasks that have none because a worker died."""
    unfinished: list[EvaluationTask] = []
    if not tasks:
        return unfinished
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(workers, context, initializer=signal.signal, initargs=_DEFAULT_SIGTERM) as pool:
        futures: dict[Future[EvaluationResult], EvaluationTask] = {
            pool.submit(_run_in_worker, task): task for task in tasks
        }
        for future in as_completed(futures):
            task, error = futures[future], future.exception()
            if error is None:
                yield future.result()
            elif isinstance(error, BrokenProcessPool):
                unfinished.append(task)
            else:
                logger.error("task %s", task.id, exc_info=error)
                yield failed_result(task, f"the evaluation failed unexpectedly: {error!r}", ENGINE)
    return unfinished


_DEFAULT_SIGTERM = (signal.SIGTERM, signal.SIG_DFL)


def _run_in_worker(task: EvaluationTask) -> EvaluationResult:
    return run_task(task, _references)


def _read_job(arguments: Sequence[str]) -> tuple[EvaluationTask, ...]:
    if len(arguments) != 1:
        raise InvalidInput(f"expected one argument, the job file, got {len(arguments)}", "evaluate.py job.json")
    path = Path(arguments[0])
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput(f"job file {path} cannot be read: {error}") from None
    return job_from_json(text)


def _end_with_parent() -> None:
    """Make the kernel end this process when its parent is killed, since nobody else would."""
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if str(os.getppid()) != parent:  # it was killed before
        os._exit(ENDED_BY_SIGTERM)


def _usable_cores() -> int:
    return len(os.sched_getaffinity(0))


def _end(_number: int, _frame: FrameType | None) -> None:
    """End at once, with the workers. Files on disk are complete, since each is renamed into place."""
    children = multiprocessing.active_children()
    for child in children:
        child.kill()
    for child in children:
        child.join(_REAP_TIMEOUT_S)
    os._exit(ENDED_BY_SIGTERM)
