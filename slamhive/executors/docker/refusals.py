"""Refusals of processes by the kernel, per container. The counters vanish with it, so they are read before."""

from __future__ import annotations

import threading
from typing import Any, Protocol

import docker.errors

from slamhive.clock import monotonic_s
from slamhive.executors.base import EngineUnavailable
from slamhive.executors.cgroup import task_counter_of
from slamhive.executors.docker.engine import engine_errors
from slamhive.executors.refusal_watch import RefusalWatch
from slamhive.executors.status import Protections

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
            with engine_errors("reading statistics", EngineUnavailable):
                try:
                    self._full = is_full(self._container.stats(stream=False, one_shot=True))
                except docker.errors.NotFound:
                    self._full = False
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
