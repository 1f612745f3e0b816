"""Runs algorithms as processes of this machine.

Each run has a supervisor (:mod:`slamhive.executors.process.shim`) that outlives the worker. A run is not isolated
like a container: it can read what its user can read.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import psutil

import slamhive
from slamhive.base.clock import monotonic_s
from slamhive.base.errors import Unavailable
from slamhive.base.files import write_aside
from slamhive.base.tree import remove_tree
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import (
    Capabilities,
    EvaluationPlace,
    Executor,
    ExecutorContext,
    ImageMissing,
    LiveKeys,
    PackageNeed,
    ProgressCallback,
    ProtectionFinding,
    StartFailed,
)
from slamhive.executors.process.cgroup_home import NO_SCOPE, run_in_scope, scope_wanted
from slamhive.executors.process.containment import found_again
from slamhive.executors.process.containment_base import WHOLE_CORES, Containment, DoesNotHold
from slamhive.executors.process.environment import INHERITED, KEY_VARIABLE, Environments, pip_problem, shim_spec_of
from slamhive.executors.process.exit_file import EXIT_FILE, assemble
from slamhive.executors.process.run_cgroup import RunCgroup, group_name, left_over_groups
from slamhive.executors.process.shim import IDENTITY_FILE, LOCK_FILE, NO_ROOM
from slamhive.executors.process.supervisor import OUTPUT_FOLDER
from slamhive.executors.process.survey import survey, survey_goes_on
from slamhive.executors.process.table import all_processes, end_all, living, process_birth
from slamhive.executors.process.tree_limit import ProcessTreeSource
from slamhive.executors.spec import Limit, RunSpec
from slamhive.executors.status import Exited, Gone, Protections, RunHandle, Running, RunStatus, UsageSource

# The supervisors of runs, seen from the worker: started, found again, and cleaned up after.


START_WAIT_S = 15.0
KILL_WAIT_S = 5.0
_ASKED_FILE = "asked-to-end"
_STEP_S = 0.02
_ERRORS_BYTES = 4096


def containment_of(handle: RunHandle) -> Containment | None:
    """The containment of the run, if others than its supervisor can use it."""
    return found_again(json.loads(handle.data.get("containment", "{}")))


def launch(work: Path, *, in_scope: bool = False) -> dict[str, Any]:
    """Start a supervisor for ``work``, and wait until it or an earlier one has written its identity.

    Raises StartFailed; Unavailable or OSError if the disk is full, which is not the run's fault.

    Args:
        work: The run's work folder, with the orders.
        in_scope: Ask systemd for a scope for it. If that fails, the supervisor starts without, and records why.
    """
    errors = work / "shim-errors.txt"
    with errors.open("wb") as stream:
        stream.write(b" " * _ERRORS_BYTES)  # so that a full disk does not hide the reason
    package_root = str(Path(slamhive.__file__).parent.parent)
    environment = {key: os.environ[key] for key in INHERITED if key in os.environ} | {"PYTHONPATH": package_root}
    command = [sys.executable, "-m", "slamhive.executors.process.shim", str(work)]
    with errors.open("r+b") as stream:
        refused = run_in_scope(command, environment, stream.fileno()) if in_scope else ""
        if refused is not None:
            # If the first one has started all the same, it holds the lock, and this one ends at once.
            arguments = [NO_SCOPE, refused] if refused else []
            subprocess.run(
                [*command, *arguments],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                cwd="/",
                check=False,
            )
    if not wait_until(lambda: (work / IDENTITY_FILE).exists() or _said(errors).startswith(NO_ROOM), START_WAIT_S):
        raise StartFailed(f"the supervisor process did not start: {_said(errors) or 'it says nothing'}")
    if not (work / IDENTITY_FILE).exists():
        raise Unavailable(f"the supervisor process did not start: {_said(errors)}", "make room on the disk")
    identity = read_json(work / IDENTITY_FILE)
    assert identity is not None
    return identity


def _said(errors: Path) -> str:
    """The last line that a supervisor has written."""
    lines = errors.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else ""


def read_json(path: Path) -> dict[str, Any] | None:
    """A file that a supervisor writes in one step; None if it is not there yet."""
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    return content


class RecordedEnd(NamedTuple):
    """The end of a run, and whether somebody other than a worker asked for it: the exit code says nothing then."""

    exited: Exited
    from_outside: bool


def read_end(handle: RunHandle) -> RecordedEnd | None:
    """Read how the run ended; None if it has not, or if nobody recorded it."""
    work = Path(handle.data["work"])
    content = read_json(work / EXIT_FILE)
    if content is None:
        return None
    exited = Exited(
        exit_code=content["exit_code"],
        out_of_memory=content["out_of_memory"],
        process_limit=content.get("process_limit", False),
        refused_processes=content.get("refused_processes", False),
        started_at=datetime.fromisoformat(content["started_at"]),
        ended_at=datetime.fromisoformat(content["ended_at"]),
    )
    return RecordedEnd(exited, bool(content.get("signalled")) and not (work / _ASKED_FILE).exists())


def note_asked(handle: RunHandle) -> None:
    """Note that a worker ends the run, before it does so."""
    with contextlib.suppress(OSError):  # a disk that is full must not keep a run alive
        (Path(handle.data["work"]) / _ASKED_FILE).touch()


def supervisor_of(handle: RunHandle) -> psutil.Process | None:
    """The supervisor if it is alive; a process with its pid may be another one, so the start time counts too."""
    pid = int(handle.data["pid"])
    if process_birth(pid) != handle.data["birth"]:
        return None
    try:
        return psutil.Process(pid)
    except psutil.NoSuchProcess:
        return None


def kill_leftovers(handle: RunHandle) -> None:
    """Kill what a killed supervisor leaves: the members of its containment, and processes with the run's key."""
    supervisor = supervisor_of(handle)
    if supervisor is not None:
        send_signal(supervisor, signal.SIGKILL)
        # Until it has ended it holds the lock on the run's user, and nobody else can tell who belongs to the run.
        wait_until(lambda: supervisor_of(handle) is None, KILL_WAIT_S)
    containment = containment_of(handle)
    if containment is not None:
        containment.end(KILL_WAIT_S)
        containment.remove()
    mark = f"{KEY_VARIABLE}={handle.data['key']}".encode()
    end_all(lambda: [entry for entry in living(all_processes()) if mark in _environment(entry.pid)], KILL_WAIT_S)


def _environment(pid: int) -> list[bytes]:
    try:
        return Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return []


def send_signal(process: psutil.Process, number: signal.Signals) -> None:
    """Send a signal, unless the process has ended."""
    try:
        process.send_signal(number)
    except psutil.NoSuchProcess:
        return


def wait_until(condition: Callable[[], bool], patience_s: float) -> bool:
    """Wait for ``condition``; returns whether it came true within ``patience_s``."""
    deadline_s = monotonic_s() + patience_s
    while not condition():
        if monotonic_s() >= deadline_s:
            return False
        time.sleep(_STEP_S)
    return True


logger = logging.getLogger(__name__)

_CONTAIN_BETTER = "use Docker, or run the worker where systemd delegates control groups to it: see docs/protections.md"


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

    def examine(self) -> list[ProtectionFinding]:
        """Try out how limits are enforced on this machine, as a supervisor does."""
        protections = survey(self._context.installation, self._containment)
        reasons = "; ".join(f"no {way}: {reason}" for way, reason in protections.does_not_hold.items())
        return [
            ProtectionFinding("protections", protections.text, f"{reasons}; {_CONTAIN_BETTER}" if reasons else None)
        ]

    def no_part_of_a_core(self) -> str | None:
        """Try out if the kernel limits the CPU time of a run."""
        try:
            protections = survey(self._context.installation, self._containment)
        except DoesNotHold as error:
            return str(error)
        if protections.cpu != WHOLE_CORES:
            return None
        reasons = "; ".join(f"no {way}: {reason}" for way, reason in protections.does_not_hold.items())
        return f"runs are {WHOLE_CORES} here" + (f" ({reasons})" if reasons else "")

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

    def has(self, package: AlgorithmPackage, identity: str) -> bool:
        """Return whether the environment with these hashes is there."""
        return self._environments.find(package.name, identity).ready

    def forget(self, package: str, identity: str, number: int) -> None:  # noqa: ARG002 - the hashes name it
        """Remove the environment, but not the runtime, which all packages share."""
        self._environments.remove(package, identity)

    def start(self, spec: RunSpec) -> RunHandle:
        """Start a supervisor for the run, or find the one that was started under the key."""
        work = _work_folder(spec)
        identity = read_json(work / IDENTITY_FILE)
        if identity is None:
            environment = self._environments.find(spec.package, spec.identity)
            if not environment.ready:
                raise ImageMissing(f"the environment {spec.identity} of {spec.package} is gone", "build it again")
            shim_spec_of(spec, environment, work, self._context, self._containment).save(work)
            in_scope = self._containment in (None, RunCgroup.kind) and scope_wanted()
            identity = launch(work, in_scope=in_scope)
        return _handle(spec, work, identity)

    def poll(self, handle: RunHandle) -> RunStatus:
        """``exit.json`` says how the run ended. A supervisor without one was killed."""
        ended = _end_of(handle)
        if ended is not None:
            return ended
        if supervisor_of(handle) is not None:
            return Running()
        return _end_of(handle) or Gone("the supervisor process was killed, or the machine restarted")

    def stop(self, handle: RunHandle, grace_s: float) -> None:
        """SIGTERM to all processes of the run, SIGKILL after ``grace_s``."""
        note_asked(handle)
        for number, patience_s in ((signal.SIGTERM, grace_s), (signal.SIGUSR1, KILL_WAIT_S)):
            shim = supervisor_of(handle)
            if shim is None:
                break
            send_signal(shim, number)
            if wait_until(lambda: supervisor_of(handle) is None, patience_s):
                break
        kill_leftovers(handle)

    def save_log(self, handle: RunHandle, path: Path) -> None:
        """Write what the run has printed so far; nothing once the run was removed."""
        work = Path(handle.data["work"])
        if work.is_dir():
            lost = (read_json(work / EXIT_FILE) or {}).get("lost_output", "")
            write_aside(path, assemble(work / OUTPUT_FOLDER) + lost.encode())

    def remove(self, handle: RunHandle) -> None:
        """Kill what is left of the run and delete its work folder."""
        shim = supervisor_of(handle)
        if shim is not None:
            self.stop(handle, 0.0)
        kill_leftovers(handle)
        remove_work(Path(handle.data["work"]))

    def discard(self, spec: RunSpec) -> None:
        """End and remove the run, whichever supervisor it has. Waits for one that is just starting."""
        work = _work_folder(spec)
        try:
            descriptor = os.open(work / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except FileNotFoundError:
            return
        try:
            # While this process has the lock, no supervisor begins. One that has the lock writes its identity soon.
            wait_until(lambda: _try_lock(descriptor) or (work / IDENTITY_FILE).exists(), START_WAIT_S)
            identity = read_json(work / IDENTITY_FILE)
            if identity is not None:
                self.remove(_handle(spec, work, identity))
            remove_work(work)
        finally:
            os.close(descriptor)

    def sweep(self, live_keys: LiveKeys) -> list[str]:
        """End and remove the control groups of runs that are over, and the remains of environments."""
        self._environments.sweep()
        found = list(left_over_groups(self._context.installation))
        live = {group_name(self._context.installation, key) for key in live_keys()}
        removed = []
        for name, group in found:
            if name not in live and not survey_goes_on(name):
                group.end(KILL_WAIT_S)
                group.remove()
                removed.append(name)
        return removed

    def usage_source(self, handle: RunHandle) -> UsageSource | None:
        """Counters of the run's control group if there is one, else of the processes below the supervisor."""
        shim = supervisor_of(handle)
        if shim is None:
            return None
        containment = containment_of(handle)
        return (None if containment is None else containment.usage()) or ProcessTreeSource(shim)


def _end_of(handle: RunHandle) -> Exited | Gone | None:
    """Return the end of the run, if recorded. What a machine does that shuts down says nothing about a run."""
    end = read_end(handle)
    if end is None:
        return None
    exited = end.exited
    if exited.out_of_memory or exited.process_limit or not end.from_outside:
        return exited
    return Gone(f"it was ended from outside, by a signal that no worker sent (exit code {exited.exit_code})")


def _work_folder(spec: RunSpec) -> Path:
    return spec.work.resolve()


def remove_work(work: Path) -> None:
    """Delete the work folder of a run; what cannot be deleted is left, with a warning."""
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


def _try_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
