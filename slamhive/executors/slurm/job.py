"""What is submitted for a run: pure functions from its specification."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import slamhive
from slamhive.executors.slurm.gres import with_gpu
from slamhive.executors.spec import Limits, Placing, RunSpec

ERRORS_FILE = "shim-errors.txt"
_SUPERVISOR_BYTES = 200_000_000
"""Slurm counts the supervisor and the process that measures with the run."""
_EXCLUDE = "--exclude="
_MOST_NICE = 60
_LATEST_END_S = 120.0
"""The worker enforces the time limit. Slurm ends a run so much later if the worker is away."""


def comment_of(installation: str, key: str) -> str:
    """By this comment a job is found again."""
    return f"slamhive:{installation}:{key}"


def job_limits(limits: Limits) -> Limits:
    """The limits that the supervisor on the node enforces.

    Slurm chooses the cores. Numbers of cores of the controller's machine mean nothing there, but how many counts.
    """
    cores = limits.cpu_cores if limits.cpuset is None else float(len(limits.cpuset))
    return replace(limits, cpuset=None, cpu_cores=cores)


def job_options(spec: RunSpec, installation: str, options: Sequence[str], gpu: str) -> list[str]:
    """The arguments of ``sbatch``. ``options`` are those of the user; ``gpu`` is the resource that is a GPU."""
    work, limits = spec.work.resolve(), job_limits(spec.limits)
    chosen = [
        f"--job-name=slamhive-{spec.run_id}",
        f"--comment={comment_of(installation, spec.key)}",
        f"--time={math.ceil((spec.timeout_s + _LATEST_END_S) / 60)}",
        "--nodes=1",
        "--ntasks=1",
        "--no-requeue",
        "--chdir=/",
        f"--output={work / ERRORS_FILE}",
        "--open-mode=append",
    ]
    if limits.cpu_cores is not None:
        chosen.append(f"--cpus-per-task={math.ceil(limits.cpu_cores)}")
    if limits.memory_bytes is not None:
        chosen.append(f"--mem={math.ceil((limits.memory_bytes + _SUPERVISOR_BYTES) / 2**20)}M")
    return [*chosen, *place_options(spec.placing, with_gpu(options, gpu) if spec.asks_gpu else options)]


def place_options(placing: Placing, options: Sequence[str]) -> list[str]:
    """``options`` of the user, with what they and ``placing`` exclude in one option: the last one would win.

    Nodes of unknown CPU model are not excluded. A run that comes to one and does not fit starts again elsewhere.
    """
    asked = [option.removeprefix(_EXCLUDE) for option in options if option.startswith(_EXCLUDE)]
    rest = [option for option in options if not option.startswith(_EXCLUDE)]
    excluded = [*asked[-1:], *placing.other_nodes]
    nice = [] if placing.expected_s is None else [f"--nice={niceness(placing.expected_s)}"]
    return [*nice, *rest, *([_EXCLUDE + ",".join(excluded)] if excluded else [])]


def niceness(expected_s: float) -> int:
    """A point for each minute that a run is shorter than an hour: of the runs that wait, the longest starts first.

    So few points order the runs of one worker, and mean little against the jobs of others.
    """
    return max(0, _MOST_NICE - int(expected_s / 60))


def job_script(work: Path, *, gpu: bool = False) -> str:
    """The script of the job. The supervisor takes the place of the shell, so that signals to the script reach it."""
    folder = str(work.resolve())
    asked = ["gpu"] if gpu else []
    return (
        "#!/bin/sh\n"
        # An orphan: what the supervisor's own children use is counted for the run.
        f"({shlex.join(node_program('measure', folder))} &)\n"
        f"exec {shlex.join(node_program('supervise', folder, *asked))}\n"
    )


def node_program(*arguments: str) -> list[str]:
    """The command for :mod:`slamhive.executors.slurm.node` on a node."""
    path = str(Path(slamhive.__file__).parent.parent)
    return ["env", f"PYTHONPATH={path}", sys.executable, "-m", "slamhive.executors.slurm.node", *arguments]
