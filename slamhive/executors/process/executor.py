"""Runs algorithms as processes of this machine.

Each run has a supervisor (:mod:`slamhive.executors.process.shim`) that outlives the worker. A run is not isolated
like a container: it can read what its user can read.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection
from datetime import datetime
from pathlib import Path
from typing import Any

import psutil

import slamhive
from slamhive.clock import monotonic_s
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import (
    Capabilities,
    EvaluationPlace,
    Executor,
    ExecutorContext,
    Finding,
    ImageMissing,
    PackageNeed,
    ProgressCallback,
    StartFailed,
)
from slamhive.executors.process.capped_log import assemble
from slamhive.executors.process.containment import found_again
from slamhive.executors.process.containment_base import Containment
from slamhive.executors.process.environment import Environment, Environments, pip_problem
from slamhive.executors.process.exit_file import EXIT_FILE
from slamhive.executors.process.paths import INHERITED, KEY_VARIABLE, shim_spec_of
from slamhive.executors.process.run_cgroup import group_name, left_over_groups
from slamhive.executors.process.shim import IDENTITY_FILE, LOCK_FILE, OUTPUT_FOLDER, process_birth
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.process.survey import survey
from slamhive.executors.process.table import ProcessEntry, all_processes, end_all, living
from slamhive.executors.process.tree_usage import ProcessTreeSource
from slamhive.executors.spec import Limit, RunSpec
from slamhive.executors.status import Exited, Gone, Protections, RunHandle, Running, RunStatus, UsageSource
from slamhive.files import write_aside
from slamhive.tree import remove_tree

logger = logging.getLogger(__name__)

_CONTAIN_BETTER = (
    "use Docker, or let control groups be written: start the worker as root, "
    "or with systemd-run --user --scope -p Delegate=yes slamhive worker"
)
_START_WAIT_S = 15.0
_KILL_WAIT_S = 5.0
_STEP_S = 0.02


class ProcessExecutor(Executor):
    """The executor ``process``.

    Args:
        context: Where environments lie, and whose runs these are.
        containment: The only way to contain runs, one of ``containment.KINDS``; None for the strongest that works here.
    """

    name = "process"
    capabilities = Capabilities(
        limits=frozenset({Limit.CORES, Limit.MEMORY, Limit.PROCESSES, Limit.DISK}),
        needs=PackageNeed.ENVIRONMENT,
        evaluates_in=EvaluationPlace.PROCESS,
        preference=20,
    )

    def __init__(self, context: ExecutorContext, containment: str | None = None) -> None:
        super().__init__(context)
        self._containment = containment
        self._environments = Environments(context.data.resolve())

    def unavailable_because(self) -> str | None:
        """Why processes cannot be used here; None if they can."""
        if sys.platform != "linux":
            return f"the process executor needs Linux, this is {sys.platform}; use Docker"
        return pip_problem()

    def examine(self) -> list[Finding]:
        """How limits are enforced on this machine: tried out, as a supervisor does."""
        protections = survey(self._context.installation, self._containment)
        reasons = "; ".join(f"no {way}: {reason}" for way, reason in protections.does_not_hold.items())
        return [Finding("protections", protections.text, f"{reasons}; {_CONTAIN_BETTER}" if reasons else None)]

    def check_package(self, package: AlgorithmPackage) -> None:
        """Raise ImageMissing if the package has no environment."""
        self._environments.identity(package)

    def identity(self, package: AlgorithmPackage) -> str | None:
        """The hashes of the environment; None if it has to be made. Raises ImageMissing if that is impossible."""
        identity = self._environments.identity(package)
        return identity if self._environments.find(package.name, identity).ready else None

    def build(self, package: AlgorithmPackage, progress: ProgressCallback) -> str:
        """Make the package's environment unless it is there. Raises ImageMissing."""
        return self._environments.build(package, progress)

    def start(self, spec: RunSpec) -> RunHandle:
        """Start a supervisor for the run, or find the one that was started under the key."""
        work = _work_folder(spec)
        identity = _read_json(work / IDENTITY_FILE)
        if identity is None:
            environment = self._environments.find(spec.package, spec.identity)
            if not environment.ready:
                raise ImageMissing(f"the environment {spec.identity} of {spec.package} is gone", "build it again")
            self._shim_spec(spec, environment, work).save(work)
            identity = _launch(work)
        return _handle(spec, work, identity)

    def poll(self, handle: RunHandle) -> RunStatus:
        """``exit.json`` says how the run ended. A supervisor without one was killed."""
        exited = _read_exit(handle)
        if exited is not None:
            return exited
        if _shim(handle) is not None:
            return Running()
        return _read_exit(handle) or Gone("the supervisor process was killed, or the machine restarted")

    def stop(self, handle: RunHandle, grace_s: float) -> None:
        """SIGTERM to all processes of the run, SIGKILL after ``grace_s``."""
        for number, patience_s in ((signal.SIGTERM, grace_s), (signal.SIGUSR1, _KILL_WAIT_S)):
            shim = _shim(handle)
            if shim is None:
                break
            _send(shim, number)
            if _wait_until(lambda: _shim(handle) is None, patience_s):
                break
        _kill_leftovers(handle)

    def save_log(self, handle: RunHandle, path: Path) -> None:
        """Write what the run has printed so far; nothing once the run was removed."""
        work = Path(handle.data["work"])
        if work.is_dir():
            lost = (_read_json(work / EXIT_FILE) or {}).get("lost_output", "")
            write_aside(path, assemble(work / OUTPUT_FOLDER) + lost.encode())

    def remove(self, handle: RunHandle) -> None:
        """Kill what is left of the run and delete its work folder."""
        shim = _shim(handle)
        if shim is not None:
            self.stop(handle, 0.0)
        _kill_leftovers(handle)
        _remove_work(Path(handle.data["work"]))

    def discard(self, spec: RunSpec) -> None:
        """End and remove the run, whichever supervisor it has. Waits for one that is just starting."""
        work = _work_folder(spec)
        try:
            descriptor = os.open(work / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except FileNotFoundError:
            return
        try:
            # While this process has the lock, no supervisor begins. One that has the lock writes its identity soon.
            _wait_until(lambda: _try_lock(descriptor) or (work / IDENTITY_FILE).exists(), _START_WAIT_S)
            identity = _read_json(work / IDENTITY_FILE)
            if identity is not None:
                self.remove(_handle(spec, work, identity))
            _remove_work(work)
        finally:
            os.close(descriptor)

    def sweep(self, live_keys: Collection[str]) -> list[str]:
        """End and remove the control groups of runs that are over, and the remains of environments."""
        self._environments.sweep()
        live = {group_name(self._context.installation, key) for key in live_keys}
        removed = []
        for name, group in left_over_groups(self._context.installation):
            if name not in live:
                group.end(_KILL_WAIT_S)
                group.remove()
                removed.append(name)
        return removed

    def usage_source(self, handle: RunHandle) -> UsageSource | None:
        """Counters of the run's control group if there is one, else of the processes below the supervisor."""
        shim = _shim(handle)
        if shim is None:
            return None
        containment = _containment(handle)
        return (None if containment is None else containment.usage()) or ProcessTreeSource(shim)

    def _shim_spec(self, spec: RunSpec, environment: Environment, work: Path) -> ShimSpec:
        return shim_spec_of(spec, environment, work, self._context, self._containment)


def _work_folder(spec: RunSpec) -> Path:
    return spec.work.resolve()


def _remove_work(work: Path) -> None:
    try:
        remove_tree(work)
    except OSError as error:
        logger.warning("%s is left: %s", work, error.strerror)


def _handle(spec: RunSpec, work: Path, identity: dict[str, Any]) -> RunHandle:
    data = {"work": str(work), "key": spec.key}
    data |= {name: str(identity[name]) for name in ("pid", "birth", "started_at")}
    # The supervisor of an earlier version, which may still live, does not write these.
    data["containment"] = json.dumps(identity.get("containment", {}))
    protections = identity.get("protections")
    return RunHandle(ProcessExecutor.name, data, None if protections is None else Protections(**protections))


def _containment(handle: RunHandle) -> Containment | None:
    """The containment of the run, if others than its supervisor can use it."""
    return found_again(json.loads(handle.data.get("containment", "{}")))


def _try_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _launch(work: Path) -> dict[str, Any]:
    """Start a supervisor for ``work``, and wait until it or an earlier one has written its identity."""
    errors = work / "shim-errors.txt"
    package_root = str(Path(slamhive.__file__).parent.parent)
    environment = {key: os.environ[key] for key in INHERITED if key in os.environ}
    with errors.open("ab") as stream:
        subprocess.run(
            [sys.executable, "-m", "slamhive.executors.process.shim", str(work)],
            env={**environment, "PYTHONPATH": package_root},
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            cwd="/",
            check=False,
        )
    if not _wait_until((work / IDENTITY_FILE).exists, _START_WAIT_S):
        lines = errors.read_text(errors="replace").strip().splitlines()
        raise StartFailed(f"the supervisor process did not start: {lines[-1] if lines else 'it says nothing'}")
    identity = _read_json(work / IDENTITY_FILE)
    assert identity is not None
    return identity


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    return content


def _read_exit(handle: RunHandle) -> Exited | None:
    content = _read_json(Path(handle.data["work"]) / EXIT_FILE)
    if content is None:
        return None
    return Exited(
        exit_code=content["exit_code"],
        out_of_memory=content["out_of_memory"],
        process_limit=content.get("process_limit", False),
        refused_processes=content.get("refused_processes", False),
        started_at=datetime.fromisoformat(content["started_at"]),
        ended_at=datetime.fromisoformat(content["ended_at"]),
    )


def _shim(handle: RunHandle) -> psutil.Process | None:
    """The supervisor if it is alive; a process with its pid may be another one, so the start time counts too."""
    pid = int(handle.data["pid"])
    if process_birth(pid) != handle.data["birth"]:
        return None
    try:
        return psutil.Process(pid)
    except psutil.NoSuchProcess:
        return None


def _kill_leftovers(handle: RunHandle) -> None:
    """Kill what a killed supervisor leaves: the members of its containment, and processes with the run's key."""
    shim = _shim(handle)
    if shim is not None:
        _send(shim, signal.SIGKILL)
    containment = _containment(handle)
    if containment is not None:
        containment.end(_KILL_WAIT_S)
        containment.remove()
    end_all(lambda: _with_key(handle.data["key"]), _KILL_WAIT_S)


def _with_key(key: str) -> list[ProcessEntry]:
    """The living processes that carry the run's key in their environment."""
    mark = f"{KEY_VARIABLE}={key}".encode()
    return [entry for entry in living(all_processes()) if mark in _environment(entry.pid)]


def _environment(pid: int) -> list[bytes]:
    try:
        return Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return []


def _send(process: psutil.Process, number: signal.Signals) -> None:
    try:
        process.send_signal(number)
    except psutil.NoSuchProcess:
        return


def _wait_until(condition: Callable[[], bool], patience_s: float) -> bool:
    """Wait for ``condition``; returns whether it came true within ``patience_s``."""
    deadline_s = monotonic_s() + patience_s
    while not condition():
        if monotonic_s() >= deadline_s:
            return False
        time.sleep(_STEP_S)
    return True
