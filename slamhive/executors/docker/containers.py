"""The containers of runs in the engine: found by name, created once, started, removed, swept.

The engine remembers what runs: the name of a container follows from the run's key, and its labels hold the key, the run
and the installation. "No such container" (404) and "exists already" (409) are therefore answers, not errors.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from datetime import timedelta
from pathlib import Path
from typing import Any, Protocol

import docker
import docker.errors
from docker.types import DeviceRequest, LogConfig, Mount, Ulimit

from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.errors import Unavailable
from slamhive.base.files import remedy_of
from slamhive.domain.algorithm import RunUser
from slamhive.executors.base import EngineUnavailable, ExecutorContext, ImageMissing, LiveKeys, StartFailed
from slamhive.executors.cgroup import task_counter_of
from slamhive.executors.docker.engine import (
    GPU_LABEL,
    HARDENING,
    INSTALLATION_LABEL,
    KEY_LABEL,
    OWNER_LABEL,
    PLAIN_ENGINE,
    RUN_LABEL,
    EngineTraits,
    boot_labels,
    container_name,
    engine_errors,
    engine_time,
    statistics_of,
    traits_of,
)
from slamhive.executors.docker.run_user import container_user
from slamhive.executors.host import owner_is_dead
from slamhive.executors.refusals import RefusalWatch
from slamhive.executors.spec import ROS_ENVIRONMENT, RunSpec
from slamhive.executors.status import Protections
from slamhive.executors.transfer import has_written, make_own_copies, read_places, written_places

# The options of a run's container. Pure, so that tests can check them.


WORKER_HOME = {"HOME": "/tmp"}  # noqa: S108 - the container's own
"""The worker's user has no other folder to write to. The users of images have the home that the image gives them."""


def container_options(spec: RunSpec, context: ExecutorContext, traits: EngineTraits = PLAIN_ENGINE) -> dict[str, Any]:
    """The arguments of ``containers.create`` for a run. Pure, so that a test can check them."""
    limits = spec.limits
    home = WORKER_HOME if spec.user is RunUser.WORKER else {}
    read_only = read_places(spec)
    # /tmp counts with the result, unlike the container's own layer, and takes no memory, unlike a tmpfs.
    places = {**read_only, **written_places(spec), "/tmp": scratch_folder(spec)}  # noqa: S108 - the container's
    options: dict[str, Any] = {
        **HARDENING,
        "image": spec.identity,
        "name": container_name(spec.key),
        "entrypoint": list(spec.command),
        "command": [],
        "labels": {
            KEY_LABEL: spec.key,
            RUN_LABEL: str(spec.run_id),
            INSTALLATION_LABEL: context.installation,
        },
        "environment": {**ROS_ENVIRONMENT, **home, **spec.environment},
        # In this order, a mount below another one comes after it, and so shows in it.
        "mounts": [
            Mount(target, str(places[target]), type="bind", read_only=target in read_only) for target in sorted(places)
        ],
        "user": container_user(spec.user, rootless=traits.rootless),
        "pids_limit": limits.pids,
        "log_config": LogConfig(
            type=LogConfig.types.JSON,
            config={"max-size": str(max(1000, context.log_max_bytes // 2)), "max-file": "2"},
        ),
    }
    if limits.memory_bytes is not None:
        options["mem_limit"] = limits.memory_bytes
        options["memswap_limit"] = limits.memory_bytes
    if limits.cpu_cores is not None and traits.limits_cpu:
        options["nano_cpus"] = round(limits.cpu_cores * 1e9)
    if limits.file_bytes is not None:
        options["ulimits"] = [Ulimit(name="fsize", soft=limits.file_bytes, hard=limits.file_bytes)]
    if limits.cpuset is not None:
        options["cpuset_cpus"] = ",".join(map(str, limits.cpuset))
    if spec.shm_bytes is not None:
        options["shm_size"] = spec.shm_bytes
    if spec.gpu is not None:
        options["device_requests"] = [DeviceRequest(device_ids=[spec.gpu], capabilities=[["gpu"]])]
        options["labels"][GPU_LABEL] = spec.gpu
    return options


def scratch_folder(spec: RunSpec) -> Path:
    """The folder that the container sees as ``/tmp``."""
    return spec.work.resolve() / "tmp"


OWNER_PATIENCE = timedelta(minutes=5)
"""How long a container is kept that does not run, but whose process may live."""
_FORGOTTEN = "id already in use"
"""So Docker refuses to start a container of which containerd has a task."""
_CREATION_PATIENCE_S = 30.0
_CREATION_STEP_S = 0.05


class RunContainers:
    """The containers of the runs of one installation. ``engine`` gives the client, connecting where needed."""

    def __init__(self, engine: Callable[[], docker.DockerClient], context: ExecutorContext) -> None:
        self._engine = engine
        self._context = context

    def find(self, name_or_id: str) -> Any | None:
        """The container; None if the engine has none of that name or id."""
        with engine_errors("looking for the container", EngineUnavailable):
            try:
                return self._engine().containers.get(name_or_id)
            except docker.errors.NotFound:
                return None

    def create(self, spec: RunSpec) -> Any:
        """Create the container of a run, or find the one that somebody else creates meanwhile. Raises StartFailed."""
        scratch = scratch_folder(spec)
        try:
            scratch.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Unavailable(f"{scratch} cannot be made: {error.strerror}", remedy_of(error)) from None
        make_own_copies(spec)
        deadline_s = monotonic_s() + _CREATION_PATIENCE_S
        while True:
            with engine_errors(f"starting run {spec.run_id}", StartFailed):
                try:
                    options = container_options(spec, self._context, traits_of(self._engine()))
                    options["labels"] |= boot_labels()
                    return self._engine().containers.create(**options)
                except docker.errors.ImageNotFound:
                    raise ImageMissing(f"image {spec.image} ({spec.identity[:19]}) is gone", "build it again") from None
                except docker.errors.APIError as error:
                    if error.status_code != 409:  # its name is taken
                        raise
            container = self.find(container_name(spec.key))
            if container is not None:
                return container
            # A worker that was killed asked for it too: the engine has taken the name, and still makes the container.
            if monotonic_s() >= deadline_s:
                raise StartFailed(f"the engine does not finish the container of run {spec.run_id}", "try again")
            time.sleep(_CREATION_STEP_S)

    def start(self, container: Any, spec: RunSpec) -> None:
        """Start a container that was created; it is removed if that fails.

        It is removed as well if it ran before, because nobody knows how the run ended: an engine that is killed
        forgets what it has just started.
        """
        if has_written(spec):
            self.remove(str(container.id))
            return
        try:
            with engine_errors(f"starting run {spec.run_id}", StartFailed):
                container.start()
        except StartFailed as error:
            self.remove(str(container.id))
            if _FORGOTTEN not in error.message:
                raise

    def remove(self, container_id: str) -> None:
        """Remove a container, running or not; one that is gone is no error."""
        with engine_errors("removing a container", EngineUnavailable):
            try:
                self._engine().api.remove_container(container_id, force=True, v=True)
            except docker.errors.NotFound:
                return
            except docker.errors.APIError as error:
                if error.status_code != 409:  # 409: it is being removed already
                    raise

    def sweep(self, live_keys: LiveKeys) -> list[str]:
        """Remove those whose run is over, or whose process is dead; their names."""
        label = f"{INSTALLATION_LABEL}={self._context.installation}"
        with engine_errors("listing containers", EngineUnavailable):
            containers = self._engine().containers.list(all=True, filters={"label": label}, ignore_removed=True)
        # Asked after the list was made: a run that starts in between has a container and no key otherwise.
        keys = live_keys()
        stale = [entry for entry in containers if not _is_live(entry, keys)]
        for container in stale:
            self.remove(str(container.id))
        return [str(container.name) for container in stale]


def _is_live(container: Any, live_keys: Collection[str]) -> bool:
    """Return whether somebody still needs a container: the run of its key, or the process that it serves."""
    owner = container.labels.get(OWNER_LABEL)
    if owner is None:
        return container.labels.get(KEY_LABEL) in live_keys
    if owner_is_dead(owner):
        return False
    if container.status == "running":
        return True
    # Its owner is about to start it, or reads how it ended.
    since = engine_time(container.attrs["State"].get("FinishedAt")) or engine_time(container.attrs.get("Created"))
    return since is not None and utc_now() - since < OWNER_PATIENCE


# Refusals of processes by the kernel, per container. The counters vanish with it, so they are read before.


_ASK_EVERY_S = 1.0

DELEGATE = (
    "give your services all controllers: sudo mkdir -p /etc/systemd/system/user@.service.d; "
    "printf '[Service]\nDelegate=cpu cpuset io memory pids\n' | "
    "sudo tee /etc/systemd/system/user@.service.d/delegate.conf; sudo systemctl daemon-reload; then log in again"
)
"""What a rootless engine needs to limit the CPU time of containers: Debian 12 delegates memory and pids alone."""


class _Counter(Protocol):
    def refused(self) -> bool:
        """Return whether the container was refused a process since the last call, or is still at the limit."""


class _EngineCounter:
    """Asks an engine on another machine, which knows the number of processes but not whether more were refused."""

    def __init__(self, container: Any) -> None:
        self._container = container
        self._asked_at_s = float("-inf")
        self._full = False

    def refused(self) -> bool:
        """Return whether the container is at its limit, as of the last second."""
        if monotonic_s() - self._asked_at_s >= _ASK_EVERY_S:
            self._asked_at_s = monotonic_s()
            self._full = is_full(statistics_of(self._container))
        return self._full


class RefusedProcesses:
    """Watches the containers of one executor. Safe to share between threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._watched: dict[str, tuple[_Counter, RefusalWatch]] = {}

    def is_to_be_ended(self, container: Any) -> bool:
        """Look at a running container: whether it has been refused processes for too long."""
        with self._lock:
            counter, watch = self._watched.get(container.id) or self._begin(container)
            return watch.see(refused=counter.refused(), now_s=monotonic_s())

    def were_refused(self, container_id: str) -> bool:
        """Return whether the container was seen to be refused a process."""
        with self._lock:
            return container_id in self._watched and self._watched[container_id][1].refused

    def forget(self, container_id: str) -> None:
        """The container is removed."""
        with self._lock:
            self._watched.pop(container_id, None)

    def _begin(self, container: Any) -> tuple[_Counter, RefusalWatch]:
        files = task_counter_of(int(container.attrs["State"]["Pid"]), container.id)
        watched: tuple[_Counter, RefusalWatch] = (files or _EngineCounter(container), RefusalWatch())
        self._watched[container.id] = watched
        return watched


def is_full(stats: dict[str, Any]) -> bool:
    """Return whether a container has as many processes and threads as it may, by the engine's statistics."""
    pids = stats.get("pids_stats") or {}
    return bool(pids.get("limit")) and pids.get("current", 0) >= pids["limit"]


def engine_protections(info: dict[str, Any]) -> Protections:
    """Return how the engine enforces limits, by what it reports about its kernel (``docker info``)."""

    def enforced(able: str, file: str) -> str:
        return f"enforced by the kernel ({file})" if info.get(able) else "not enforced: the engine's kernel cannot"

    v1 = str(info.get("CgroupVersion", "1")) == "1"
    return Protections(
        held_by=f"container, control groups version {1 if v1 else 2}",
        processes=enforced("PidsLimit", "pids.max"),
        memory=enforced("MemoryLimit", "memory.limit_in_bytes" if v1 else "memory.max"),
        cpu=enforced("CpuCfsQuota", "cpu.cfs_quota_us" if v1 else "cpu.max"),
        end="all processes of the container are killed at once",
        priority="the run has its own share of the processors",
    )
