"""Container runtimes that need no root: the command of each, and which of them a node has.

All start the same folder. The tests try Charliecloud, and Apptainer where it is installed; Podman is unverified.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from slamhive.base.errors import Unavailable
from slamhive.base.files import write_aside
from slamhive.executors.process import confinement
from slamhive.executors.slurm.gpus import VISIBLE

ORDERS_FILE = "container.json"
AUTO, NONE, APPTAINER = "auto", "none", "apptainer"
_WORKING_FOLDER = "/tmp"  # noqa: S108 - in the container
_HOME = "HOME"
_NEEDED_ON_NODE = ("PATH", "USER", _HOME, "XDG_RUNTIME_DIR")
_TIMEOUT_S = 20.0


@dataclass(frozen=True, slots=True)
class ContainerOrders:
    """The program to start in a container, whichever runtime does it.

    Attributes:
        runtime: The key of the runtime to use; ``auto`` for the first that the node has.
        image: The folder with the files of the image, or a SIF file, which Apptainer alone can start.
        command: Program and arguments in the container.
        environment: All variables of the command.
        read: {path in the container: path on the node} of what it must not change.
        written: The same for what it may change.
        gpus: The GPUs of the run, by UUID or number; the node knows them.
    """

    runtime: str
    image: str
    command: list[str]
    environment: dict[str, str]
    read: dict[str, str]
    written: dict[str, str]
    gpus: list[str] = field(default_factory=list)

    def mounts(self) -> list[tuple[str, str, bool]]:
        """(path on the node, path in the container, may be changed) of all files, outer folders first."""
        places = {**self.read, **self.written}
        return [(places[target], target, target in self.written) for target in sorted(places)]

    def save(self, work: Path) -> None:
        """Write into the work folder."""
        write_aside(work / ORDERS_FILE, json.dumps(asdict(self)))

    @classmethod
    def load(cls, work: Path) -> ContainerOrders | None:
        """Read from the work folder; None for a run without a container."""
        try:
            return cls(**json.loads((work / ORDERS_FILE).read_text(encoding="utf-8")))
        except FileNotFoundError:
            return None


@dataclass(frozen=True, slots=True)
class ContainerCommand:
    """A command, and what is added to the environment of the runtime itself.

    ``forwarders`` are the programs of the runtime that stay and pass signals on.
    """

    arguments: list[str]
    environment: dict[str, str]
    forwarders: tuple[str, ...] = ()


def charliecloud(program: str, orders: ContainerOrders) -> ContainerCommand:
    """``ch-run`` has no network of its own and mounts everything writable: the supervisor takes care of both."""
    return ContainerCommand(
        [
            program,
            "--unset-env=*",
            "--env-no-expand",
            *(f"--set-env={name}={value}" for name, value in orders.environment.items()),
            "--private-tmp",
            *(f"--bind={source}:{target}" for source, target, _ in orders.mounts()),
            f"--cd={_WORKING_FOLDER}",
            orders.image,
            "--",
            *orders.command,
        ],
        {},
    )


def apptainer(program: str, orders: ContainerOrders) -> ContainerCommand:
    """``apptainer exec`` without its setuid helper. Variables pass through its environment, which knows no commas.

    It lets nobody set ``HOME`` in this way: the home folder is an option of its own.
    """
    home = orders.environment.get(_HOME)
    mounted = [(source, target, "rw" if written else "ro") for source, target, written in orders.mounts()]
    homes = [f"--home={source}:{target}" for source, target, _ in mounted if target == home]
    variables = {name: value for name, value in orders.environment.items() if name != _HOME}
    return ContainerCommand(
        [
            program,
            "--quiet",
            "exec",
            "--userns",
            "--containall",
            *(homes or ["--no-home"]),
            "--net",
            "--network=none",
            *(["--nv"] if orders.gpus else []),
            *(f"--bind={source}:{target}:{rights}" for source, target, rights in mounted if target != home),
            f"--pwd={_WORKING_FOLDER}",
            orders.image,
            *orders.command,
        ],
        {f"APPTAINERENV_{name}": value for name, value in variables.items()},
        ("starter", "appinit"),
    )


def write_sif(root: Path, file: Path) -> None:
    """Make a SIF file of a folder with the files of an image. Raises Unavailable."""
    command = [RUNTIMES[APPTAINER].program, "--quiet", "build", str(file), str(root)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise Unavailable(f"{command[0]} cannot be started: {error.strerror}") from None
    if done.returncode:
        raise Unavailable(f"apptainer build failed: {' '.join(done.stderr.split())[-300:]}")


def podman(program: str, orders: ContainerOrders) -> ContainerCommand:
    """``podman run`` in the control group of the supervisor, which therefore enforces the limits.

    The container sees its GPUs alone, so that their numbers on the node mean nothing in it.
    """
    hidden = VISIBLE if orders.gpus else ()
    return ContainerCommand(
        [
            program,
            "run",
            "--rm",
            "--network=none",
            "--cgroups=disabled",
            "--log-driver=none",
            "--cap-drop=all",
            "--security-opt=no-new-privileges",
            "--read-only",
            "--userns=keep-id",
            *(f"--device=nvidia.com/gpu={gpu}" for gpu in orders.gpus),
            *(f"--env={name}={value}" for name, value in orders.environment.items() if name not in hidden),
            *(f"--volume={source}:{target}:{'rw' if written else 'ro'}" for source, target, written in orders.mounts()),
            f"--workdir={_WORKING_FOLDER}",
            "--rootfs",
            orders.image,
            *orders.command,
        ],
        {},
        ("podman", "conmon", "crun", "runc"),
    )


@dataclass(frozen=True, slots=True)
class Runtime:
    """A container runtime: its name in words, its program, and how it is called."""

    label: str
    program: str
    command: Callable[[str, ContainerOrders], ContainerCommand]


RUNTIMES = {
    "charliecloud": Runtime("Charliecloud", "ch-run", charliecloud),
    APPTAINER: Runtime("Apptainer", "apptainer", apptainer),
    "podman": Runtime("Podman", "podman", podman),
}
"""In the order of preference: what asks for least comes first."""


@dataclass(frozen=True, slots=True)
class Tried:
    """A runtime on this node: its version if it can be used, otherwise why not."""

    key: str
    version: str = ""
    problem: str = ""

    @property
    def text(self) -> str:
        """Name and version, or name and problem."""
        label = RUNTIMES[self.key].label
        return f"{label}: {self.problem}" if self.problem else f"{label} {self.version}"


def try_runtimes(asked: str = AUTO) -> Iterator[Tried]:
    """Examine the runtimes of this node one after the other: all, or the one that was asked for."""
    refused = confinement.refused_because()
    return (_try(key, refused) for key in RUNTIMES if asked in (AUTO, key))


def choose_runtime(tried: Iterable[Tried]) -> Tried:
    """The first that can be used. Raises LookupError with the reasons why none can."""
    problems = []
    for entry in tried:
        if not entry.problem:
            return entry
        problems.append(entry.text)
    raise LookupError("; ".join(problems))


def command_of(orders: ContainerOrders, runtime: Tried) -> ContainerCommand:
    """Return the command that the supervisor starts on this node, with all variables of the runtime itself."""
    found = RUNTIMES[runtime.key]
    called = found.command(shutil.which(found.program) or found.program, orders)
    inherited = {name: os.environ[name] for name in _NEEDED_ON_NODE if name in os.environ}
    environment = {"USER": str(os.getuid()), **inherited, **called.environment}
    return replace(called, environment=environment)


def _try(key: str, refused: str | None) -> Tried:
    program = RUNTIMES[key].program
    if shutil.which(program) is None:
        return Tried(key, problem=f"there is no {program} in PATH")
    if refused is not None:
        return Tried(key, problem=f"it needs user namespaces, which this node refuses: {refused}")
    environment = {"USER": str(os.getuid()), **os.environ}
    try:
        done = subprocess.run(
            [program, "--version"], env=environment, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return Tried(key, problem=f"{program} --version failed: {error}")
    said = (done.stdout + done.stderr).split()
    if done.returncode or not said:
        return Tried(key, problem=f"{program} --version failed: {' '.join(said)[:200]}")
    return Tried(key, said[-1])
