"""An executor that runs nothing: each test says how the run behaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from slamhive.base.project import project_root
from slamhive.evaluation.process import ProcessStarter
from slamhive.executors.base import Capabilities, Executor
from slamhive.executors.spec import Limit, RunSpec
from slamhive.executors.status import Exited, Protections, RunHandle, Running, RunStatus

PROTECTIONS = Protections("nothing", "none", "none", "none", "none", "none", {"cgroup": "it is a fake"})


@dataclass
class FakeExecutor(Executor):
    """Statuses come from ``statuses``, the last one stays; an exception in the list is raised once."""

    name = "process"
    capabilities = Capabilities(limits=frozenset(Limit), preference=20)

    statuses: list[RunStatus | Exception] = field(default_factory=lambda: [Exited(0)])
    on_start: Callable[[RunSpec], None] = lambda spec: None
    build_error: Exception | None = None
    start_error: Exception | None = None
    starts: list[RunSpec] = field(default_factory=list)
    stopped: int = 0
    graces_s: list[float] = field(default_factory=list)
    removed: int = 0
    discarded: list[str] = field(default_factory=list)

    def unavailable_because(self) -> str | None:
        return None

    def evaluation_starter(self) -> ProcessStarter:
        return ProcessStarter(project_root())

    def identity(self, package) -> str | None:
        return "sha256:abc"

    def build(self, package, progress) -> str:
        if self.build_error is not None:
            raise self.build_error
        progress("built")
        return "sha256:abc"

    def start(self, spec: RunSpec) -> RunHandle:
        if self.start_error is not None:
            raise self.start_error
        self.starts.append(spec)
        self.on_start(spec)
        return RunHandle("process", {"key": spec.key}, PROTECTIONS)

    def poll(self, handle: RunHandle) -> RunStatus:
        status = self.statuses[0] if len(self.statuses) == 1 else self.statuses.pop(0)
        if isinstance(status, Exception):
            raise status
        return status

    def stop(self, handle: RunHandle, grace_s: float) -> None:
        self.stopped += 1
        self.graces_s.append(grace_s)
        self.statuses = [Exited(137)]

    def save_log(self, handle: RunHandle, path: Path) -> None:
        path.write_text("hello\n")

    def remove(self, handle: RunHandle) -> None:
        self.removed += 1

    def discard(self, spec: RunSpec) -> None:
        self.discarded.append(spec.key)


class FakeDocker(FakeExecutor):
    """The same under the other name."""

    name = "docker"
    capabilities = replace(FakeExecutor.capabilities, preference=10)


def write_trajectory(poses: int = 3) -> Callable[[RunSpec], None]:
    """A start that leaves a trajectory on a curve, at timestamps of the tiny dataset."""

    def on_start(spec: RunSpec) -> None:
        result = spec.output("result").destination
        (result / "traj.txt").write_text("".join(f"{100 + i / 3:.6f} {i} {i * i} 0 0 0 0 1\n" for i in range(poses)))

    return on_start


__all__ = ["FakeDocker", "FakeExecutor", "Running", "write_trajectory"]
