"""An executor in one file: each run is a plain process, found again by a variable that all of its processes inherit.

It limits nothing, so it promises nothing: SLAM Hive leaves out its default limits and refuses the limits of users.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import psutil

from slamhive.base.clock import monotonic_s
from slamhive.base.files import write_aside
from slamhive.base.settings import ExecutorOption
from slamhive.base.tree import remove_tree
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import (
    Capabilities,
    Executor,
    ExecutorContext,
    ImageMissing,
    ProgressCallback,
    StartFailed,
)
from slamhive.executors.process.environment import Environments
from slamhive.executors.process.tree_limit import ProcessTreeSource
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Exited, Gone, RunHandle, Running, RunStatus
from slamhive.executors.transfer import make_own_copies, read_places, written_places

KEY_VARIABLE = "PLAIN_RUN_KEY"
PATIENCE_S = 10.0
SHELL = ExecutorOption("shell", "/bin/sh", "The shell that starts algorithms")  # the setting PLAIN_SHELL

# Whoever makes the folder "started" runs the command, so that two workers start one run. The shell outlives SIGTERM to
# write the exit code. A file appears in one step, or it could be read half-written.
SCRIPT = """
mkdir started 2>/dev/null || exit 0
trap : TERM
echo $$ > pid.part && mv pid.part pid
"$@" > output 2>&1 < /dev/null
echo $? > exit.part && mv exit.part exit
"""


class PlainExecutor(Executor):
    """The executor ``plain``."""

    name = "plain"
    capabilities = Capabilities(several_at_once=False)
    options = (SHELL,)

    def __init__(self, context: ExecutorContext) -> None:
        super().__init__(context)
        self._environments = Environments(context.data.resolve())

    def unavailable_because(self) -> str | None:
        shell = self._context.value(SHELL)
        return None if Path(shell).exists() else f"there is no shell {shell}; change PLAIN_SHELL"

    def check_package(self, package: AlgorithmPackage) -> None:
        self._environments.identity(package)  # raises ImageMissing for a package without requirements.txt

    def identity(self, package: AlgorithmPackage) -> str | None:
        identity = self._environments.identity(package)
        return identity if self._environments.find(package.name, identity).ready else None

    def build(self, package: AlgorithmPackage, progress: ProgressCallback) -> str:
        return self._environments.build(package, progress)

    def start(self, spec: RunSpec) -> RunHandle:
        refusal = self.capabilities.refusal(self.name, spec.limits)
        if refusal is not None:
            raise StartFailed(refusal, "leave the limit out, or choose another executor")
        work = spec.work.resolve() / "plain"
        if not (work / "pid").exists():
            self._launch(spec, work)
        if not _wait_until((work / "pid").exists, PATIENCE_S):
            raise StartFailed(f"run {spec.run_id} did not start", "look at the load of the machine")
        return RunHandle(self.name, {"key": spec.key, "work": str(work), "started_at": _time(work / "pid")})

    def poll(self, handle: RunHandle) -> RunStatus:
        work, key = Path(handle.data["work"]), handle.data["key"]
        alive = bool(_processes(key))
        if (work / "exit").exists():
            _end(key, 0.0)  # what the algorithm has left behind
            started_at, ended_at = (datetime.fromisoformat(_time(work / name)) for name in ("pid", "exit"))
            return Exited(int((work / "exit").read_text()), started_at=started_at, ended_at=ended_at)
        return Running() if alive else Gone("all of its processes were killed from outside")

    def stop(self, handle: RunHandle, grace_s: float) -> None:
        work = Path(handle.data["work"])
        _end(handle.data["key"], grace_s)
        if work.is_dir() and not (work / "exit").exists():
            write_aside(work / "exit", "137")

    def save_log(self, handle: RunHandle, path: Path) -> None:
        output, half = Path(handle.data["work"], "output"), self._context.log_max_bytes // 2
        if output.exists():
            text = output.read_bytes()
            write_aside(path, text if len(text) <= 2 * half else text[:half] + b"\n[...]\n" + text[-half:])

    def remove(self, handle: RunHandle) -> None:
        _end(handle.data["key"], 0.0)
        remove_tree(Path(handle.data["work"]))

    def discard(self, spec: RunSpec) -> None:
        _end(spec.key, 0.0)
        remove_tree(spec.work.resolve() / "plain")

    def usage_source(self, handle: RunHandle) -> ProcessTreeSource | None:
        try:
            return ProcessTreeSource(psutil.Process(int(Path(handle.data["work"], "pid").read_text())))
        except (FileNotFoundError, psutil.NoSuchProcess):
            return None

    def _launch(self, spec: RunSpec, work: Path) -> None:
        environment = self._environments.find(spec.package, spec.identity)
        if not environment.ready:
            raise ImageMissing(f"the environment {spec.identity} of {spec.package} is gone", "build it again")
        make_own_copies(spec)
        places = read_places(spec) | written_places(spec)
        dataset = work / "dataset"
        dataset.mkdir(parents=True, exist_ok=True)
        for target, place in places.items():
            if target.startswith("/slamhive/dataset/"):
                link = dataset / target.removeprefix("/slamhive/dataset/")
                link.unlink(missing_ok=True)
                link.symlink_to(place)
        scripts = spec.package_folder.resolve() / "slamhive"
        script = places.get("/slamhive/mapping.py", scripts / "mapping.py")
        variables = {
            "PATH": os.environ["PATH"],
            "HOME": str(work),
            "PYTHONPATH": str(environment.runtime),
            "PYTHONUNBUFFERED": "1",
            "SLAMHIVE_CONFIG": str(places["/slamhive/config.yaml"]),
            "SLAMHIVE_DATASET": str(dataset),
            "SLAMHIVE_RESULT": str(places["/slamhive/result"]),
            "SLAMHIVE_PREPARED": str(environment.prepared),
            **{name: str(places.get(value, value)) for name, value in spec.environment.items()},
            KEY_VARIABLE: spec.key,
        }
        # In a session of its own, and no child of this process: the run outlives the worker and leaves it no zombie.
        command = [
            "setsid",
            "--fork",
            self._context.value(SHELL),
            "-c",
            SCRIPT,
            "sh",
            str(environment.python),
            *(str(script) if word == "/slamhive/mapping.py" else word for word in spec.command[1:]),
        ]
        subprocess.run(command, cwd=work, env=variables, check=True)


def _processes(key: str) -> list[psutil.Process]:
    """The processes of a run, wherever they have moved to. A process that clears its variables gets away."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get(KEY_VARIABLE) == key and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except psutil.Error:
            continue  # it has ended, or belongs to somebody else
    return found


def _end(key: str, grace_s: float) -> None:
    for process in _processes(key) if grace_s > 0 else ():
        process.terminate()
    _wait_until(lambda: not _processes(key), grace_s)
    while members := _processes(key):
        for process in members:
            process.kill()
        psutil.wait_procs(members, timeout=1.0)


def _time(path: Path) -> str:
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat()


def _wait_until(condition: Callable[[], bool], patience_s: float) -> bool:
    deadline_s = monotonic_s() + patience_s
    while not condition():
        if monotonic_s() >= deadline_s:
            return False
        time.sleep(0.02)
    return True
