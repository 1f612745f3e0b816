"""Jobs that are submitted at the same time share one job array: pure functions.

The comment of a job names its run, and that of an array names the runs of all of its tasks in their order. So a task is
found like any other job, and nothing has to remember which task belongs to which run.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

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


class Submission(NamedTuple):
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


def submission(requests: Sequence[JobRequest]) -> Submission:
    """One request as a job; several, which have equal options, as an array. The order of its tasks is theirs."""
    first, *others = requests
    if not others:
        return Submission(_arguments(first.name, [first], first.printed), _START + first.commands)
    tasks = "".join(
        f"{task})\nexec >>{shlex.quote(str(request.printed))} 2>&1\n{request.commands};;\n"
        for task, request in enumerate(requests)
    )
    arguments = _arguments(f"{first.name}-and-{len(others)}", requests, NOWHERE)
    script = f"{_START}case $SLURM_ARRAY_TASK_ID in\n{tasks}esac\n"
    return Submission([*arguments, f"--array=0-{len(others)}"], script)


def _arguments(name: str, requests: Sequence[JobRequest], printed: Path) -> list[str]:
    comment = comment_of(requests[0].installation, *(request.key for request in requests))
    always = [f"--job-name={name}", f"--comment={comment}", f"--output={printed}", "--open-mode=append"]
    return [*always, *requests[0].options]
