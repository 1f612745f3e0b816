"""CPU and memory of a supervised process tree, through psutil."""

from __future__ import annotations

import psutil

from slamhive.clock import monotonic_s

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
