"""The last resort, without control groups and without a user for each run: the supervisor counts processes.

For users other than root the kernel still enforces a ceiling (RLIMIT_NPROC). It counts all processes of the user, so
the ceiling is well above the limit of the run.
"""

from __future__ import annotations

import os
import resource
from typing import Any

from slamhive.executors.process.cgroup_home import smallest_limit_around
from slamhive.executors.process.containment_base import ContainmentRequest, Look, ProcessTree
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
            "cpu": "bound to whole cores",
            "end": "all processes below the supervisor are stopped, then killed",
        }

    def enter(self) -> None:
        """Implement :class:`Containment`."""
        if self._ceiling is None:
            return
        hard = resource.getrlimit(resource.RLIMIT_NPROC)[1]
        ceiling = self._ceiling if hard == resource.RLIM_INFINITY else min(self._ceiling, hard)
        resource.setrlimit(resource.RLIMIT_NPROC, (ceiling, ceiling))

    def look(self, tree: ProcessTree) -> Look:
        """Implement :class:`Containment`."""
        return Look(refused=tree.tasks() > self._tasks)

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
