"""Evaluates every task of a job on all cores, whatever single tasks do."""

from __future__ import annotations

import ctypes
import io
import json
import logging
import multiprocessing
import os
import signal
import sys
import zipfile
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import FrameType

import numpy as np

from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.base.files import write_aside
from slamhive.evaluation.engine import ENGINE, Evaluated, evaluate
from slamhive.evaluation.evaluators.base import Paired
from slamhive.evaluation.evaluators.builtin import EVALUATORS
from slamhive.evaluation.job import (
    RESULT_FILE,
    Artefacts,
    EvaluationResult,
    EvaluationTask,
    failed_result,
    job_from_json,
    result_to_json,
)
from slamhive.evaluation.process import PARENT_VARIABLE
from slamhive.evaluation.references import References
from slamhive.trajectory.layout import format_tum
from slamhive.trajectory.model import Poses

# The files that an evaluation writes, each in one step, ``result.json`` last.


_ARCHIVES = ("ape", "rpe")
ALIGNED_FILE = "traj.tum"
REFERENCE_FILE = "groundtruth.tum"
ERRORS_FILE = "errors.csv"
FILES = (*(f"{name}.zip" for name in _ARCHIVES), ALIGNED_FILE, REFERENCE_FILE, ERRORS_FILE)


def run_task(task: EvaluationTask, references: References) -> EvaluationResult:
    """Evaluate one task and write the files that it asks for. A failure is written as a result with a reason."""
    try:
        _remove(task.output, [RESULT_FILE])
        evaluated = evaluate(task, references)
        if isinstance(evaluated, Evaluated):
            if evaluated.paired is None:
                _remove(task.output, FILES)
            else:
                _write_files(task, evaluated, evaluated.paired)
            result = evaluated.result
        else:
            _remove(task.output, FILES)
            result = evaluated
        write_aside(task.output / RESULT_FILE, result_to_json(result) + "\n")
    except SlamHiveError as error:
        return failed_result(task, str(error), ENGINE)
    return result


def _write_files(task: EvaluationTask, evaluated: Evaluated, paired: Paired) -> None:
    if task.artefacts is Artefacts.METRICS:
        return
    _remove(task.output, (f"{name}.zip" for name in _ARCHIVES))
    for name, result in evaluated.archives.items():
        # The zip that ``evo_res`` opens. The task's id is the estimate's name, and the trajectories lie beside it.
        # evo's own ``save_res_file`` is in a module that loads the readers of all recordings first.
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr("info.json", json.dumps(result.info | {"est_name": task.id}))
            archive.writestr("stats.json", json.dumps(result.stats))
            for key, array in result.np_arrays.items():
                with archive.open(f"{key}.npy", "w") as member:
                    np.save(member, array)
        write_aside(task.output / f"{name}.zip", buffer.getvalue())
    write_aside(task.output / ALIGNED_FILE, _tum(paired.aligned))
    write_aside(task.output / REFERENCE_FILE, _tum(paired.reference))
    rows = np.column_stack((paired.aligned.stamps_s, evaluated.archives["ape"].np_arrays["error_array"]))
    errors_csv = "timestamp,ape_m\n" + ("%.9f,%.9f\n" * len(rows)) % tuple(rows.ravel().tolist())
    write_aside(task.output / ERRORS_FILE, errors_csv)
    if task.artefacts is Artefacts.PLOTS:
        # Plotting loads Matplotlib and evo's settings, which metrics alone do not need.
        from slamhive.evaluation.plots import write_plots  # noqa: PLC0415

        write_plots(task.output, paired, evaluated.archives)


def load_libraries(tasks: Iterable[EvaluationTask]) -> None:
    """Import plug-ins and the libraries that the files of ``tasks`` need, so that forked workers inherit them.

    Otherwise two workers could write evo's settings file at the same time.
    """
    EVALUATORS.names()  # loads plug-ins
    if Artefacts.PLOTS in {task.artefacts for task in tasks}:
        import slamhive.evaluation.plots  # noqa: F401, PLC0415


def _tum(poses: Poses) -> str:
    return format_tum(poses.stamps_s, poses.positions_m, poses.quats_xyzw)


def _remove(folder: Path, names: Iterable[str]) -> None:
    """Remove the files of an earlier evaluation, and partly written ones of a killed evaluation."""
    try:
        for name in names:
            (folder / name).unlink(missing_ok=True)
            for unfinished in folder.glob(f".{name}.*"):
                unfinished.unlink(missing_ok=True)
    except OSError as error:
        raise Unavailable(f"{folder} cannot be written: {error.strerror}", "check space and rights") from None


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
        if len(arguments) != 1:
            raise InvalidInput(f"expected one argument, the job file, got {len(arguments)}", "evaluate.py job.json")
        path = Path(arguments[0])
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidInput(f"job file {path} cannot be read: {error}") from None
        tasks = job_from_json(text)
    except SlamHiveError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    for result in evaluate_all(tasks, len(os.sched_getaffinity(0))):
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


def _end_with_parent() -> None:
    """Make the kernel end this process when its parent is killed, since nobody else would."""
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if str(os.getppid()) != parent:  # it was killed before
        os._exit(ENDED_BY_SIGTERM)


def _end(_number: int, _frame: FrameType | None) -> None:
    """End at once, with the workers. Files on disk are complete, since each is renamed into place."""
    children = multiprocessing.active_children()
    for child in children:
        child.kill()
    for child in children:
        child.join(_REAP_TIMEOUT_S)
    os._exit(ENDED_BY_SIGTERM)
