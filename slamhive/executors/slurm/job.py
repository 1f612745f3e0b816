"""Submissions of runs: pure functions from its specification."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import slamhive
from slamhive.executors.node_store.on_node.run import Ticket
from slamhive.executors.slurm.arrays import NOWHERE, JobRequest
from slamhive.executors.slurm.gres import with_gpu
from slamhive.executors.spec import Limits, Placing, RunSpec

ERRORS_FILE = "shim-errors.txt"
_SUPERVISOR_BYTES = 200_000_000
"""Slurm counts the supervisor and the process that measures with the run."""
_MAKING_BYTES_PER_S = 5e6
"""No node is expected to make a variant more slowly than this."""
_EXCLUDE = "--exclude="
_MOST_NICE = 60
_DELIVERY_S = 7200.0
_KEPT_FOR_DELIVERY = ("--partition=", "--account=", "--qos=", "--reservation=")
_LATEST_END_S = 120.0
"""The worker enforces the time limit. Slurm ends a run so much later if the worker is away."""


def job_limits(limits: Limits) -> Limits:
    """The limits that the supervisor on the node enforces.

    Slurm chooses the cores. Numbers of cores of the controller's machine mean nothing there, but how many counts.
    """
    cores = limits.cpu_cores if limits.cpuset is None else float(len(limits.cpuset))
    return replace(limits, cpuset=None, cpu_cores=cores)


def job_request(
    spec: RunSpec, installation: str, options: Sequence[str], gpu: str, commands: str, printed: Path | None = None
) -> JobRequest:
    """Return the submission of a run.

    Args:
        spec: The run.
        installation: Whose run it is.
        options: Those of the user.
        gpu: The resource that is a GPU.
        commands: What the job does.
        printed: Where the node writes what the job itself prints; None for a file in the work folder.
    """
    limits = job_limits(spec.limits)
    making_s = 0.0 if spec.variant is None else spec.variant.room_bytes / _MAKING_BYTES_PER_S
    chosen = _always(spec.timeout_s + making_s + _LATEST_END_S)
    if limits.cpu_cores is not None:
        chosen.append(f"--cpus-per-task={math.ceil(limits.cpu_cores)}")
    if limits.memory_bytes is not None:
        chosen.append(f"--mem={math.ceil((limits.memory_bytes + _SUPERVISOR_BYTES) / 2**20)}M")
    chosen += place_options(spec.placing, with_gpu(options, gpu) if spec.asks_gpu else options)
    printed = printed or spec.work.resolve() / ERRORS_FILE
    return JobRequest(f"slamhive-{spec.run_id}", installation, spec.key, printed, tuple(chosen), commands)


def delivery_request(installation: str, key: str, node: str, options: Sequence[str], commands: str) -> JobRequest:
    """Return the submission that brings what the run ``key`` has left on ``node``."""
    kept = [option for option in options if option.startswith(_KEPT_FOR_DELIVERY)]
    chosen = (*_always(_DELIVERY_S), f"--nodelist={node}", f"--mem={_SUPERVISOR_BYTES >> 20}M", *kept)
    return JobRequest("slamhive-results", installation, key, NOWHERE, chosen, commands, secret=True)


def _always(limit_s: float) -> list[str]:
    return [f"--time={math.ceil(limit_s / 60)}", "--nodes=1", "--ntasks=1", "--no-requeue", "--chdir=/"]


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


def job_commands(work: Path, *, gpu: bool = False) -> str:
    """Return the script of a job. The supervisor replaces the shell, so that signals to the script reach it."""
    folder = str(work.resolve())
    asked = ["gpu"] if gpu else []
    return (
        # An orphan: what the supervisor's own children use is counted for the run.
        f"({shlex.join(node_program('measure', folder))} &)\n"
        f"exec {shlex.join(node_program('supervise', folder, *asked))}\n"
    )


def ticket_commands(ticket: Ticket, purpose: str, python: str) -> str:
    """Return the script of a job on a node that does not see our files. The ticket is secret: others see command lines.

    Args:
        ticket: What the node needs to begin.
        purpose: ``run``, or ``deliver`` for what an earlier job has left.
        python: The Python of the nodes; empty for the worker's own.
    """
    program = [*_python(python), "-m", "slamhive.executors.slurm.agent", purpose]
    return f"exec {shlex.join(program)} <<'TICKET'\n{json.dumps(ticket._asdict())}\nTICKET\n"


def node_program(*arguments: str, python: str = "") -> list[str]:
    """The command for :mod:`slamhive.executors.slurm.node` on a node; ``python`` as for :func:`ticket_commands`."""
    return [*_python(python), "-m", "slamhive.executors.slurm.node", *arguments]


def _python(python: str) -> list[str]:
    path = str(Path(slamhive.__file__).parent.parent)
    return [python] if python else ["env", f"PYTHONPATH={path}", sys.executable]
