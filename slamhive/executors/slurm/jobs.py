"""Submissions of runs: pure functions from its specification."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import slamhive
from slamhive.executors.node_store.on_node.run import Ticket
from slamhive.executors.slurm.gpus import with_gpu
from slamhive.executors.spec import Placing, ResourceLimits, RunSpec

# Jobs that are submitted at the same time share one job array: pure functions.
#
# The comment of a job names its run, and that of an array names the runs of all of its tasks in their order. So a
# task is found like any other job, and nothing has to remember which task belongs to which run.


NOWHERE = Path("/dev/null")
_LONGEST_COMMENT = 1024
"""Slurm refuses more characters."""
_OURS = "slamhive"
_BETWEEN_KEYS = ","
_START = "#!/bin/sh\n"


class JobRequest(NamedTuple):
    """The submission of one run.

    Attributes:
        name: What ``squeue`` shows.
        installation: Whose run it is.
        key: Identifies the run.
        printed: Where the node writes what the job itself prints.
        options: The other arguments of ``sbatch``. Requests with equal ones may become one array.
        commands: What the job does: lines for a shell.
        secret: They hold what only the node of this run may know. All nodes of an array see its whole script.
    """

    name: str
    installation: str
    key: str
    printed: Path
    options: tuple[str, ...]
    commands: str
    secret: bool = False


class ArraySubmission(NamedTuple):
    """Arguments of ``sbatch``, and the script of the job or array."""

    arguments: list[str]
    script: str


def comment_of(installation: str, *keys: str) -> str:
    """By this comment jobs are found again."""
    return f"{_OURS}:{installation}:{_BETWEEN_KEYS.join(keys)}"


def comments_of_tasks(comment: str) -> list[str]:
    """The comments that the tasks of an array would have as jobs; none if the array is not one of ours."""
    ours, _, rest = comment.partition(":")
    installation, separator, keys = rest.partition(":")
    if ours != _OURS or not separator:
        return []
    return [comment_of(installation, key) for key in keys.split(_BETWEEN_KEYS)]


def tasks_in(text: str) -> Iterator[int]:
    """The numbers in the words of Slurm for tasks that wait, such as ``0-3,7,10-20:2%4``. Raises ValueError."""
    for part in filter(None, text.partition("%")[0].split(",")):
        numbers, _, step = part.partition(":")
        first, _, last = numbers.partition("-")
        yield from range(int(first), int(last or first) + 1, int(step or 1))


def chunks(requests: Iterable[JobRequest]) -> list[list[JobRequest]]:
    """Requests that may be submitted together, in their order. Those of a chunk have equal options."""
    found: list[list[JobRequest]] = []
    open_chunks: dict[object, list[JobRequest]] = {}
    for request in requests:
        shared = (request.installation, request.options)
        chunk = open_chunks.get(shared, [])
        keys = [entry.key for entry in chunk] + [request.key]
        fits = len(comment_of(request.installation, *keys)) <= _LONGEST_COMMENT
        if not chunk or not fits or request.secret or any(_BETWEEN_KEYS in key for key in keys):
            chunk = open_chunks[shared] = []
            found.append(chunk)
        chunk.append(request)
        if request.secret:
            del open_chunks[shared]
    return found


def submission(requests: Sequence[JobRequest]) -> ArraySubmission:
    """One request as a job; several, which have equal options, as an array. The order of its tasks is theirs."""
    first, *others = requests
    if not others:
        return ArraySubmission(_arguments(first.name, [first], first.printed), _START + first.commands)
    tasks = "".join(
        f"{task})\nexec >>{shlex.quote(str(request.printed))} 2>&1\n{request.commands};;\n"
        for task, request in enumerate(requests)
    )
    arguments = _arguments(f"{first.name}-and-{len(others)}", requests, NOWHERE)
    script = f"{_START}case $SLURM_ARRAY_TASK_ID in\n{tasks}esac\n"
    return ArraySubmission([*arguments, f"--array=0-{len(others)}"], script)


def _arguments(name: str, requests: Sequence[JobRequest], printed: Path) -> list[str]:
    comment = comment_of(requests[0].installation, *(request.key for request in requests))
    always = [f"--job-name={name}", f"--comment={comment}", f"--output={printed}", "--open-mode=append"]
    return [*always, *requests[0].options]


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


def job_limits(limits: ResourceLimits) -> ResourceLimits:
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
