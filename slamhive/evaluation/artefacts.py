"""The files that an evaluation writes, each in one step, ``result.json`` last."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from evo.core.result import Result

from slamhive.errors import SlamHiveError, Unavailable
from slamhive.evaluation.engine import ENGINE, Evaluated, evaluate
from slamhive.evaluation.evaluators.base import Paired
from slamhive.evaluation.evaluators.builtin import EVALUATORS
from slamhive.evaluation.job import (
    RESULT_FILE,
    Artefacts,
    EvaluationResult,
    EvaluationTask,
    failed_result,
    result_to_json,
)
from slamhive.evaluation.references import References
from slamhive.files import write_aside
from slamhive.trajectory.model import Poses
from slamhive.trajectory.tum import format_tum

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
        write_aside(task.output / f"{name}.zip", _result_archive(result, task.id))
    write_aside(task.output / ALIGNED_FILE, _tum(paired.aligned))
    write_aside(task.output / REFERENCE_FILE, _tum(paired.reference))
    write_aside(task.output / ERRORS_FILE, _errors_csv(paired, evaluated.archives["ape"]))
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


def _errors_csv(paired: Paired, ape: Result) -> str:
    rows = np.column_stack((paired.aligned.stamps_s, ape.np_arrays["error_array"]))
    return "timestamp,ape_m\n" + ("%.9f,%.9f\n" * len(rows)) % tuple(rows.ravel().tolist())


def _result_archive(result: Result, name: str) -> bytes:
    """The zip that ``evo_res`` opens, with the task's id as the estimate's name; the trajectories lie beside it.

    As by evo's ``save_res_file``, whose module loads the readers of all recordings first.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("info.json", json.dumps(result.info | {"est_name": name}))
        archive.writestr("stats.json", json.dumps(result.stats))
        for key, array in result.np_arrays.items():
            with archive.open(f"{key}.npy", "w") as member:
                np.save(member, array)
    return buffer.getvalue()


def _remove(folder: Path, names: Iterable[str]) -> None:
    """Remove the files of an earlier evaluation, and partly written ones of a killed evaluation."""
    try:
        for name in names:
            (folder / name).unlink(missing_ok=True)
            for unfinished in folder.glob(f".{name}.*"):
                unfinished.unlink(missing_ok=True)
    except OSError as error:
        raise Unavailable(f"{folder} cannot be written: {error.strerror}", "check space and rights") from None
