"""Runs algorithms in Docker containers, hardened as the container contract says."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import docker
import docker.errors

from slamhive.base.files import write_aside
from slamhive.domain.algorithm import AlgorithmPackage, Gpu
from slamhive.evaluation.process import BatchStarter
from slamhive.executors.base import (
    Capabilities,
    EngineUnavailable,
    EvaluationPlace,
    Executor,
    ExecutorContext,
    GpuGiver,
    ImageTools,
    LiveKeys,
    PackageNeed,
    ProgressCallback,
    ProtectionFinding,
    StartFailed,
)
from slamhive.executors.cgroup import cgroup_of, file_cache_bytes, present
from slamhive.executors.docker.batch import DockerStarter
from slamhive.executors.docker.containers import (
    DELEGATE,
    RefusedProcesses,
    RunContainers,
    engine_protections,
    in_words,
    open_to_user,
    take_back,
)
from slamhive.executors.docker.engine import (
    GPU_LABEL,
    KEY_LABEL,
    EngineTraits,
    connect,
    container_name,
    engine_errors,
    engine_time,
    information_of,
    is_of_earlier_boot,
    lifetime,
    statistics_of,
    traits_of,
)
from slamhive.executors.docker.foreign_images import DockerImages
from slamhive.executors.docker.images import (
    PACKING_TIMEOUT_S,
    find_image,
    forget_image,
    get_image,
    has_image,
    kept_name,
    load_image,
    make_image,
    name_image,
    save_image,
)
from slamhive.executors.gpu import GpuUse, gpu_use, in_container, list_gpus
from slamhive.executors.spec import Limit, RunSpec
from slamhive.executors.status import Exited, Gone, RunHandle, Running, RunStatus, UsageSource

# CPU and memory of a container from the engine's statistics, where its control group is on another machine.


_NS = 1e-9


class DockerStatsSource:
    """Asks for one reading at a time; the engine's own peak counter is there under control groups version 1 only."""

    on_this_machine = False

    def __init__(self, container: Any) -> None:
        self._container = container
        self._totals: dict[str, float] = {}

    def read(self) -> tuple[float, int] | None:
        """CPU time (s) and memory in use (bytes); None once the container has ended."""
        stats = statistics_of(self._container)
        usage = parse_stats(stats)
        if usage is not None:
            self._totals |= present({"ram.charged_max": stats["memory_stats"].get("max_usage")})
        return usage

    def totals(self) -> dict[str, float]:
        """Return the counters of the last reading."""
        return self._totals

    def close(self) -> None:
        """Nothing is held open."""


def parse_stats(stats: dict[str, Any]) -> tuple[float, int] | None:
    """CPU time (s) and memory in use (bytes) of one reading; None for a container that does not run."""
    memory = stats.get("memory_stats") or {}
    if "usage" not in memory:
        return None
    cache = file_cache_bytes(memory.get("stats") or {})
    cpu_s = stats["cpu_stats"]["cpu_usage"]["total_usage"] * _NS
    return cpu_s, max(0, memory["usage"] - cache)


class DockerExecutor(Executor):
    """The executor ``docker``. Safe to share between threads."""

    name = "docker"
    capabilities = Capabilities(
        isolates=True,
        limits=frozenset({Limit.CORES, Limit.MEMORY, Limit.PROCESSES, Limit.DISK}),
        needs=PackageNeed.IMAGE,
        gpu=GpuGiver.WORKER,
        evaluates_in=EvaluationPlace.CONTAINER,
        takes_runs_along=True,
        preference=10,
    )

    def __init__(self, context: ExecutorContext) -> None:
        super().__init__(context)
        self._lock = threading.Lock()
        self._client: docker.DockerClient | None = None
        self._refused = RefusedProcesses()
        self._containers = RunContainers(self._engine, context)

    def unavailable_because(self) -> str | None:
        """Why Docker cannot be used now; None if an engine answers."""
        try:
            with engine_errors("asking the Docker engine", EngineUnavailable):
                self._engine().ping()
        except EngineUnavailable as error:
            return str(error)
        return None

    def examine(self) -> list[ProtectionFinding]:
        """Return how the engine's kernel enforces limits."""
        information = information_of(self._engine())
        found = engine_protections(information)
        lacks = "not enforced" in found.text
        remedy = DELEGATE if lacks and EngineTraits.of(information).rootless else None
        return [ProtectionFinding("protections", found.text, remedy)]

    def identity(self, package: AlgorithmPackage) -> str | None:
        """The digest of the image of this version of the package; None if it has to be built or pulled."""
        return find_image(self._engine(), package, self._context.project_root)

    def build(self, package: AlgorithmPackage, progress: ProgressCallback) -> str:
        """Find, pull or build the image; returns its digest. Raises ImageMissing."""
        return make_image(self._engine(), package, self._context, progress)

    def has(self, package: AlgorithmPackage, identity: str) -> bool:  # noqa: ARG002 - a digest names one image
        """Return whether the engine has the image with this digest."""
        return has_image(self._engine(), identity)

    def named_image(self, package: AlgorithmPackage) -> str | None:
        """The digest of the image with the package's name."""
        image = get_image(self._engine(), package.image)
        return None if image is None else str(image.id)

    def keep(self, package: AlgorithmPackage, identity: str, number: int) -> None:
        """Give the image a name of its own, which ``docker image prune`` leaves alone."""
        name_image(self._engine(), identity, self._kept_name(package.name, number))

    def forget(self, package: str, identity: str, number: int) -> None:
        """Take the name away, and with it the image unless it has others."""
        forget_image(self._engine(), identity, self._kept_name(package, number))

    def save_image(self, identity: str) -> Iterator[bytes]:
        """The image as ``docker save`` writes it, without names."""
        with contextlib.closing(connect(PACKING_TIMEOUT_S)) as client:
            yield from save_image(client, identity)

    def load_image(self, chunks: Iterable[bytes]) -> str:
        """Load an image; its digest."""
        with contextlib.closing(connect(PACKING_TIMEOUT_S)) as client:
            return load_image(client, chunks)

    def image_tools(self) -> ImageTools:
        """Takes images that somebody else made."""
        return DockerImages(self._engine(), self._context.installation)

    def start(self, spec: RunSpec) -> RunHandle:
        """Create and start the run's container, or find it in whatever state it is."""
        information = information_of(self._engine())  # asked once: it takes an engine tens of milliseconds
        traits = EngineTraits.of(information)
        container = self._containers.find(container_name(spec.key)) or self._containers.create(spec, traits)
        if container.labels.get(KEY_LABEL) != spec.key:
            raise StartFailed(f"container {container.name} belongs to another run", f"docker rm {container.name}")
        open_to_user(spec, rootless=traits.rootless)
        if container.status == "created":
            if is_of_earlier_boot(container):
                self._containers.remove(str(container.id))
                container = self._containers.create(spec, traits)
            self._containers.start(container, spec)
        data = {"container": str(container.id), "key": spec.key}
        started = self._containers.find(data["container"])
        started_at = None if started is None else engine_time(started.attrs["State"].get("StartedAt"))
        if started_at is not None:
            data["started_at"] = started_at.isoformat()
        found = engine_protections(information)
        user = in_words(spec.user, rootless=traits.rootless)
        return RunHandle(self.name, data, replace(found, held_by=f"{found.held_by}; {user}"))

    def poll(self, handle: RunHandle) -> RunStatus:
        """The state that the engine reports."""
        container = self._containers.find(handle.data["container"])
        if container is None:
            return Gone("the container is gone: somebody removed it, or its engine was killed as it started")
        state = container.attrs["State"]
        if state["Status"] == "created":
            return Gone("the container was never started")
        if state["Status"] not in ("exited", "dead"):
            return Running(process_limit=self._refused.is_to_be_ended(container))
        exit_code = int(state["ExitCode"])
        if is_of_earlier_boot(container):
            return Gone(f"the machine was restarted, and nobody saw how the run ended (exit code {exit_code})")
        started_at, ended_at = lifetime(state)
        return Exited(
            exit_code=exit_code,
            out_of_memory=bool(state.get("OOMKilled")),
            refused_processes=self._refused.were_refused(str(container.id)),
            started_at=started_at,
            ended_at=ended_at,
        )

    def stop(self, handle: RunHandle, grace_s: float) -> None:
        """SIGTERM, and SIGKILL after ``grace_s``."""
        container = self._containers.find(handle.data["container"])
        if container is None:
            return
        with engine_errors(f"stopping {container.name}", EngineUnavailable):
            try:
                container.stop(timeout=max(0, round(grace_s)))
            except docker.errors.NotFound:
                return

    def save_log(self, handle: RunHandle, path: Path) -> None:
        """Write what the run has printed so far; nothing if the container is gone."""
        container = self._containers.find(handle.data["container"])
        if container is None:
            return
        with engine_errors(f"reading the log of {container.name}", EngineUnavailable):
            # The engine itself caps the log, see container_options.
            write_aside(path, container.logs(stdout=True, stderr=True))

    def remove(self, handle: RunHandle) -> None:
        """Remove the container, running or not."""
        self._containers.remove(handle.data["container"])
        self._refused.forget(handle.data["container"])

    def discard(self, spec: RunSpec) -> None:
        """Remove the container that has the name of the run's key, unless another run's has it."""
        container = self._containers.find(container_name(spec.key))
        if container is not None and container.labels.get(KEY_LABEL) == spec.key:
            self._containers.remove(str(container.id))
        take_back(self._engine, spec, self._context.installation)

    def collect(self, spec: RunSpec, handle: RunHandle) -> None:  # noqa: ARG002 - the signature of the seam
        """Hand over what a run with a user of its own has written."""
        take_back(self._engine, spec, self._context.installation)

    def usage_source(self, handle: RunHandle) -> UsageSource | None:
        """The container's control group where its files are on this machine, the engine's statistics otherwise."""
        container = self._containers.find(handle.data["container"])
        if container is None or container.status != "running":
            return None
        group = cgroup_of(int(container.attrs["State"]["Pid"]), container.id)
        return group or DockerStatsSource(container)

    def no_part_of_a_core(self) -> str | None:
        """Ask the engine if its kernel limits the CPU time of containers."""
        return None if traits_of(self._engine()).limits_cpu else "the engine has no controller of CPU time"

    def gpus(self) -> tuple[Gpu, ...]:
        """The GPUs of this machine, which the driver lists."""
        return list_gpus()

    def gpus_in_use(self, key: str) -> frozenset[str]:
        """Read the labels of running containers."""
        with engine_errors("listing containers with a GPU", EngineUnavailable):
            found = self._engine().containers.list(filters={"label": GPU_LABEL}, ignore_removed=True)
        return frozenset(entry.labels[GPU_LABEL] for entry in found if entry.labels.get(KEY_LABEL) != key)

    def gpu_use(self, handle: RunHandle, uuid: str | None) -> GpuUse:
        """Return the driver's readings; processes are told apart by their control group."""
        return gpu_use(uuid or "", in_container(handle.data["container"]))

    def hidden_bytes(self, handle: RunHandle) -> int:
        """The size of the container's own layer."""
        with engine_errors("measuring a container", EngineUnavailable):
            found = self._engine().api.containers(all=True, size=True, filters={"id": handle.data["container"]})
        return sum(int(entry.get("SizeRw") or 0) for entry in found)

    def sweep(self, live_keys: LiveKeys) -> list[str]:
        """Remove containers of this installation whose run is over, or whose process is dead."""
        return self._containers.sweep(live_keys)

    def evaluation_starter(self) -> BatchStarter:
        """Starts containers of the evaluation image."""
        return DockerStarter(self._context)

    def close(self) -> None:
        """Close the connection to the engine."""
        with self._lock:
            if self._client is not None:
                self._client.close()
                self._client = None

    def _kept_name(self, package: str, number: int) -> str:
        return kept_name(package, number, self._context.installation)

    def _engine(self) -> docker.DockerClient:
        with self._lock:
            if self._client is None:
                self._client = connect()
            return self._client
