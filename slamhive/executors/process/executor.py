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
import sys
from pathlib import Path
from typing import Any

from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import (
    Capabilities,
    EvaluationPlace,
    Executor,
    ExecutorContext,
    Finding,
    ImageMissing,
    LiveKeys,
    PackageNeed,
    ProgressCallback,
)
from slamhive.executors.process.capped_log import assemble
from slamhive.executors.process.environment import Environment, Environments, pip_problem
from slamhive.executors.process.exit_file import EXIT_FILE
from slamhive.executors.process.paths import shim_spec_of
from slamhive.executors.process.run_cgroup import RunCgroup, group_name, left_over_groups
from slamhive.executors.process.scope import scope_wanted
from slamhive.executors.process.shim import IDENTITY_FILE, LOCK_FILE
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.process.supervisor import OUTPUT_FOLDER
from slamhive.executors.process.supervisors import (
    KILL_WAIT_S,
    START_WAIT_S,
    containment_of,
    kill_leftovers,
    launch,
    note_asked,
    read_end,
    read_json,
    send_signal,
    supervisor_of,
    wait_until,
)
from slamhive.executors.process.survey import survey, survey_goes_on
from slamhive.executors.process.tree_usage import ProcessTreeSource
from slamhive.executors.spec import Limit, RunSpec
from slamhive.executors.status import Exited, Gone, Protections, RunHandle, Running, RunStatus, UsageSource
from slamhive.files import write_aside
from slamhive.tree import remove_tree

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

    def examine(self) -> list[Finding]:
        """Try out how limits are enforced on this machine, as a supervisor does."""
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
            self._shim_spec(spec, environment, work).save(work)
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

    def _shim_spec(self, spec: RunSpec, environment: Environment, work: Path) -> ShimSpec:
        return shim_spec_of(spec, environment, work, self._context, self._containment)


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
