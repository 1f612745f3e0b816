"""Which executors there are, and which one ``auto`` means on this machine."""

from __future__ import annotations

import fcntl
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from slamhive.errors import Unavailable
from slamhive.executors.base import Executor
from slamhive.files import write_aside
from slamhive.registry import Registry

AUTO = "auto"
_INSTALLATION_FILE = "installation"


@dataclass(frozen=True, slots=True)
class ExecutorContext:
    """What every executor is made from.

    Attributes:
        data: Data root; environments and locks live below it.
        project_root: Folder with ``algorithms/`` and ``docker/``.
        installation: Tells the containers of this data root from those of another on the same engine.
        log_max_bytes: Most bytes kept of a run's output.
        containment: The one way to hold runs without a container, see ``containment.KINDS``; None for the strongest.
    """

    data: Path
    project_root: Path
    installation: str
    log_max_bytes: int = 10_000_000
    containment: str | None = None


ExecutorFactory = Callable[[ExecutorContext], Executor]

EXECUTORS: Registry[ExecutorFactory] = Registry("executor", "slamhive.executors")


def _docker(context: ExecutorContext) -> Executor:
    from slamhive.executors.docker.executor import DockerExecutor  # noqa: PLC0415 - the SDK takes 0.2 s to import

    return DockerExecutor(context)


def _process(context: ExecutorContext) -> Executor:
    from slamhive.executors.process.executor import ProcessExecutor  # noqa: PLC0415 - as above, kept alike

    return ProcessExecutor(context)


EXECUTORS.register("docker", _docker)
EXECUTORS.register("process", _process)


def open_executor(name: str, context: ExecutorContext) -> Executor:
    """The executor called ``name``, usable or not; raises NotFound that lists the choices."""
    return EXECUTORS.get(name)(context)


def choose_executor(setting: str, executor: Callable[[str], Executor]) -> tuple[Executor, str]:
    """The executor that ``setting`` means here, and the reason in words; ``executor`` gives the one of a name.

    ``auto`` is Docker if an engine answers, the process executor otherwise. Raises NotFound for an unknown name and
    Unavailable, with the remedy, if the executor asked for (or every one) cannot be used.
    """
    if setting != AUTO:
        chosen = executor(setting)
        problem = chosen.unavailable_because()
        if problem is not None:
            raise Unavailable(problem)
        return chosen, f"{setting}, as set"
    docker = executor("docker")
    docker_problem = docker.unavailable_because()
    if docker_problem is None:
        return docker, "docker: an engine answers"
    process = executor("process")
    process_problem = process.unavailable_because()
    if process_problem is not None:
        raise Unavailable(f"no executor can be used: docker: {docker_problem}; process: {process_problem}")
    return process, f"process, because {docker_problem}"


def installation_id(data: Path) -> str:
    """The identifier of the data root, made on first use and kept in ``<data>/installation``.

    All processes get the same one, whoever is first and whatever is killed meanwhile.
    """
    path = data / _INSTALLATION_FILE
    try:
        known = _read_id(path)
        if known:
            return known
        data.mkdir(parents=True, exist_ok=True)
        with (data / f".{_INSTALLATION_FILE}.lock").open("ab") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not _read_id(path):
                write_aside(path, uuid.uuid4().hex)
        return _read_id(path)
    except OSError as error:
        raise Unavailable(f"{path} cannot be used: {error.strerror}", "check space and rights") from None


def _read_id(path: Path) -> str:
    """What the file says; empty if it is not there, or was left empty."""
    try:
        return path.read_text(encoding="ascii").strip()
    except FileNotFoundError:
        return ""
