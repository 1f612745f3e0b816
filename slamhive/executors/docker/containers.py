"""The containers of runs in the engine: found by name, created once, started, removed, swept.

The engine remembers what runs: the name of a container follows from the run's key, and its labels hold the key, the run
and the installation. "No such container" (404) and "exists already" (409) are therefore answers, not errors.
"""

from __future__ import annotations

import logging
import os
import stat
import threading
import time
from collections.abc import Callable, Collection, Iterable
from datetime import timedelta
from pathlib import Path
from typing import Any, Protocol

import docker
import docker.errors
import requests
from docker.types import DeviceRequest, LogConfig, Mount, Ulimit

from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.errors import Unavailable
from slamhive.base.files import remedy_of
from slamhive.base.tree import walk
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
    information_of,
    labels_of_helper,
    statistics_of,
    traits_of,
)
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

    def create(self, spec: RunSpec, traits: EngineTraits) -> Any:
        """Create the container of a run, or find the one that somebody else creates meanwhile. Raises StartFailed.

        ``traits``: of the engine.
        """
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
                    options = container_options(spec, self._context, traits)
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


# -- runs whose image wants a user of its own --------------------------------------------------------------------------
#
# What they write is opened before the start and handed over afterwards.
# Images of the published SLAM Hive write to /root or /home, so they need the user that they were made for. The
# container has no capabilities, so its root is no master of files on this machine: folders of the run are opened to it.
# Meanwhile the folder of the run is closed to other users of the machine, since root could leave programs there that
# run as root. Afterwards all files belong to the worker, who can delete them.


logger = logging.getLogger(__name__)

ROOT = "0:0"
_OTHERS = 0o007
HANDOVER_S = 120
HANDOVER_CAPABILITIES = ["CHOWN", "DAC_OVERRIDE", "FOWNER"]
_PIDS = 16
HANDOVER = """
import os, sys
uid, gid = int(sys.argv[1]), int(sys.argv[2])
for place in sys.argv[3:]:
    for folder, folders, files in os.walk(place):
        for name in folders + files:
            os.lchown(os.path.join(folder, name), uid, gid)
"""
"""Runs in the Python of the image, 3.3 or later; ``chown`` takes away rights to run as the owner."""


def container_user(user: RunUser, *, rootless: bool) -> str | None:
    """The option ``user`` of a container; None for the user that the image names.

    Root of a rootless engine's containers is the user who runs the engine, and has no other rights on this machine.
    """
    if user is RunUser.IMAGE:
        return None
    return ROOT if rootless or user is RunUser.ROOT else f"{os.getuid()}:{os.getgid()}"


def in_words(user: RunUser, *, rootless: bool) -> str:
    """The user of the run in its container, for ``run.json`` and messages."""
    if user is RunUser.WORKER:
        inside = "; root in the container, which the engine without root makes this user" if rootless else ""
        return f"user {os.getuid()}:{os.getgid()} of the worker{inside}"
    return user.in_words


def is_foreign(user: RunUser, *, rootless: bool) -> bool:
    """Return whether the user of the run is not the worker's own."""
    return user is RunUser.IMAGE or (user is RunUser.ROOT and os.getuid() != 0 and not rootless)


def open_to_user(spec: RunSpec, *, rootless: bool) -> None:
    """Let the foreign user of a run write to its folders, and nobody else into them. Raises StartFailed."""
    if not is_foreign(spec.user, rootless=rootless):
        return
    for target, source in read_places(spec).items():
        files = [entry for entry in source.rglob("*") if entry.is_file()] if source.is_dir() else [source]
        for file in files:
            if not file.stat().st_mode & stat.S_IROTH:
                raise StartFailed(
                    f"run {spec.run_id} is {spec.user.in_words}, which may not read {file} ({target})",
                    f"chmod o+r {file}",
                )
    run_folder = spec.work.parent
    try:
        run_folder.chmod(stat.S_IMODE(run_folder.stat().st_mode) & ~_OTHERS)
        for place in (*written_places(spec).values(), spec.work / "tmp"):
            for path in (place, *place.rglob("*")):
                if not path.is_symlink():
                    path.chmod(0o777 if path.is_dir() or path.stat().st_mode & stat.S_IXUSR else 0o666)
    except OSError as error:
        problem = f"{run_folder} cannot be opened to {spec.user.in_words}: {error}"
        raise StartFailed(problem, remedy_of(error)) from None


def take_back(engine: Callable[[], docker.DockerClient], spec: RunSpec, installation: str) -> None:
    """Give what a foreign user has written in an ended run to this process's user, and close its folders again."""
    if spec.user is RunUser.WORKER:
        return
    if is_foreign(spec.user, rootless=traits_of(engine()).rootless):
        _hand_over(engine(), [*written_places(spec).values(), spec.work / "tmp"], spec.identity, installation)
        run_folder = spec.work.parent
        mode = stat.S_IMODE(run_folder.parent.stat().st_mode)  # that of new folders beside it
        for path in (run_folder, run_folder / "result"):
            if path.is_dir() and path.stat().st_uid == os.getuid():
                path.chmod(mode)


def _hand_over(client: docker.DockerClient, places: Iterable[Path], image: str, installation: str) -> None:
    """Give what lies in ``places``, folders of an ended run, to this process's user. Raises EngineUnavailable.

    Root does it itself. Others ask the engine for a container of the run's image, which has the rights to do this and
    sees the folders of this run alone.
    """
    strangers = [
        place for place in places if place.is_dir() and any(entry.status.st_uid != os.getuid() for entry in walk(place))
    ]
    if not strangers:
        return
    if os.getuid() == 0:
        _take(strangers)
        return
    mounts = [Mount(f"/handover/{number}", str(place), type="bind") for number, place in enumerate(strangers)]
    inside = [f"/handover/{number}" for number in range(len(strangers))]
    options = {**HARDENING, "mounts": mounts, "user": ROOT, "cap_add": HANDOVER_CAPABILITIES, "pids_limit": _PIDS}
    owner = ["0", "0"] if traits_of(client).rootless else [str(os.getuid()), str(os.getgid())]
    command = ["python3", "-I", "-c", HANDOVER, *owner, *inside]
    with engine_errors("handing over the files of a run", EngineUnavailable):
        security: Any = information_of(client).get("SecurityOptions") or []
        if any(str(option).startswith("name=userns") for option in security):
            options["userns_mode"] = "host"  # inside the namespace, users of this machine have no number
        container = client.containers.create(
            image, entrypoint=command, command=[], labels=labels_of_helper("handover", installation), **options
        )
        try:
            container.start()
            ended = container.wait(timeout=HANDOVER_S)["StatusCode"]
            if ended != 0:
                said = container.logs(tail=1).decode(errors="replace").strip()
                logger.warning("files in %s could not be handed over: %s", strangers[0], said)
        except requests.exceptions.RequestException as error:
            logger.warning("files in %s could not be handed over: %s", strangers[0], error)
        finally:
            container.remove(force=True, v=True)


def _take(places: Iterable[Path]) -> None:
    for place in places:
        for entry in walk(place):
            if entry.status.st_uid != os.getuid():
                os.chown(entry.name, os.getuid(), os.getgid(), dir_fd=entry.folder, follow_symlinks=False)
