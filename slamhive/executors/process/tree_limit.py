"""The last resort, without control groups and without a user for each run: the supervisor counts processes.

For users other than root the kernel still enforces a ceiling (RLIMIT_NPROC). It counts all processes of the user, so
the ceiling is well above the limit of the run.
"""

from __future__ import annotations

import os
import resource
from typing import Any

import psutil

from slamhive.base.clock import monotonic_s
from slamhive.executors.process.cgroup_home import smallest_limit_around
from slamhive.executors.process.containment_base import WHOLE_CORES, ContainmentLook, ContainmentRequest, ProcessTree
from slamhive.executors.process.table import ProcessEntry, descendants, end_all, living, processes_of_user

_ROOM_FOR_OTHERS = 512


class TreeLimit:
    """The processes below one supervisor.

    Args:
        root: The supervisor.
        tasks: Most processes and threads; a run with more is ended at once.
        ceiling: Most processes and threads of this user; None where the kernel does not enforce it.
        memory_around: The group around the run with the smallest memory limit, and that limit (bytes); None if there
            is none.
    """

    kind = "tree"
    patience_s = 0.0
    holds_memory = False
    holds_cpu = False

    def __init__(
        self, root: int, tasks: int, ceiling: int | None, memory_around: tuple[str, int] | None = None
    ) -> None:
        self._root = root
        self._tasks = tasks
        self._ceiling = ceiling
        self._memory_around = memory_around

    @classmethod
    def make(cls, request: ContainmentRequest) -> TreeLimit:
        """For the calling process and what it starts."""
        uid, memory_around = os.getuid(), smallest_limit_around("memory.max")
        if uid == 0:
            return cls(os.getpid(), request.tasks, None, memory_around)
        now = sum(entry.threads for entry in processes_of_user(uid))
        return cls(os.getpid(), request.tasks, now + 2 * request.tasks + _ROOM_FOR_OTHERS, memory_around)

    def describe(self) -> dict[str, Any]:
        """Implement :class:`Containment`: after a supervisor was killed, nothing here identifies its processes."""
        return {"kind": self.kind}

    def words(self) -> dict[str, str]:
        """Implement :class:`Containment`."""
        ceiling = "" if self._ceiling is None else f"; the kernel lets this user have {self._ceiling} in all"
        around = ""
        if self._memory_around is not None:
            around = f"; the kernel lets {self._memory_around[0]} have {self._memory_around[1] / 1e6:.0f} MB in all"
        return {
            "held_by": "the supervisor alone",
            "processes": f"counted by the supervisor, which kills a run that has too many{ceiling}",
            "memory": f"checked by the supervisor{around}",
            "cpu": WHOLE_CORES,
            "end": "all processes below the supervisor are stopped, then killed",
        }

    def enter(self) -> None:
        """Implement :class:`Containment`."""
        if self._ceiling is None:
            return
        hard = resource.getrlimit(resource.RLIMIT_NPROC)[1]
        ceiling = self._ceiling if hard == resource.RLIM_INFINITY else min(self._ceiling, hard)
        resource.setrlimit(resource.RLIMIT_NPROC, (ceiling, ceiling))

    def look(self, tree: ProcessTree) -> ContainmentLook:
        """Implement :class:`Containment`."""
        return ContainmentLook(refused=tree.tasks() > self._tasks)

    def members(self) -> list[ProcessEntry]:
        """Implement :class:`Containment`."""
        return living(descendants(self._root))

    def end(self, patience_s: float) -> bool:
        """Implement :class:`Containment`."""
        return end_all(self.members, patience_s)

    def remove(self) -> None:
        """Implement :class:`Containment`: nothing was taken."""

    def usage(self) -> None:
        """Implement :class:`Containment`."""


# CPU and memory of a supervised process tree, through psutil.


_RESCAN_S = 1.0


class ProcessTreeSource:
    """Usage of everything below a shim; the shim itself is not counted.

    CPU time is that of the living descendants plus that of all that were reaped, which the kernel adds up for each
    parent: a child that lived for a millisecond between two samples is counted. Memory is the sum of the resident
    sizes; pages shared between the processes count for each. The kernel keeps no peak for a tree.

    Listing the tree is the expensive part, so the list is refreshed once a second and when a member has ended.
    """

    on_this_machine = True

    def __init__(self, shim: psutil.Process) -> None:
        self._shim = shim
        self._members: dict[int, psutil.Process] = {}
        self._scanned_at_s = float("-inf")
        self._cpu_s = 0.0
        self._begun = False

    def read(self) -> tuple[float, int] | None:
        """CPU time (s) and resident memory (bytes); None once the shim or all below it is gone."""
        try:
            if monotonic_s() - self._scanned_at_s >= _RESCAN_S:
                self._scan()
            cpu_s, memory_bytes, complete = self._sum()
            if not complete:
                self._scan()
                cpu_s, memory_bytes, _ = self._sum()
        except psutil.NoSuchProcess:
            return None
        if not self._members and self._begun:
            return None
        if not self._members:
            # The supervisor says who it is before it starts anything.
            self._scanned_at_s = float("-inf")
        self._begun = bool(self._members)
        # A process that ends between the two reads is missing in both sums for one sample.
        self._cpu_s = max(self._cpu_s, cpu_s)
        return self._cpu_s, memory_bytes

    def totals(self) -> dict[str, float]:
        """Empty: the kernel records totals of each process only, and peaks at different moments."""
        return {}

    def close(self) -> None:
        """Nothing is held open."""

    def _scan(self) -> None:
        found = {process.pid: process for process in self._shim.children(recursive=True)}
        self._members = {pid: self._members.get(pid, process) for pid, process in found.items()}
        self._scanned_at_s = monotonic_s()

    def _sum(self) -> tuple[float, int, bool]:
        """CPU time (s), memory (bytes), and whether every known member was still there."""
        reaped = self._shim.cpu_times()
        cpu_s = reaped.children_user + reaped.children_system
        memory_bytes = 0
        complete = True
        for process in self._members.values():
            try:
                with process.oneshot():
                    times = process.cpu_times()
                    memory_bytes += process.memory_info().rss
            except psutil.NoSuchProcess:
                complete = False
                continue
            cpu_s += times.user + times.system + times.children_user + times.children_system
        return cpu_s, memory_bytes, complete
