"""CPU and memory of a container from the kernel's control-group files, versions 1 and 2.

Memory in use is usage minus file cache. The kernel charges a file to the group that reads it first, and takes the cache
back whenever somebody needs the memory. So the first run of an image would seem to need far more than its repeats. The
peak is the kernel's own counter (``memory.max_usage_in_bytes``, ``memory.peak``), which includes file cache.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

CGROUP_ROOT = Path("/sys/fs/cgroup")
_NS = 1e-9
_US = 1e-6


@dataclass(frozen=True, slots=True)
class CgroupV1:
    """The files of one container under version 1, where every controller has a tree of its own."""

    cpuacct: Path
    memory: Path
    on_this_machine: ClassVar[bool] = True

    def read(self) -> tuple[float, int] | None:
        """CPU time (s) and memory in use (bytes); None once the group is gone."""
        try:
            cpu_s = int((self.cpuacct / "cpuacct.usage").read_text()) * _NS
            usage = int((self.memory / "memory.usage_in_bytes").read_text())
            cache = file_cache_bytes(parse_flat((self.memory / "memory.stat").read_text()))
        except (OSError, ValueError):
            return None
        return cpu_s, max(0, usage - cache)

    def totals(self) -> dict[str, float]:
        """``memory.max_usage_in_bytes``."""
        return present({"ram.charged_max": _read_int(self.memory / "memory.max_usage_in_bytes")})

    def close(self) -> None:
        """Nothing is held open."""


@dataclass(frozen=True, slots=True)
class CgroupV2:
    """The files of one container under version 2, one folder for all controllers."""

    folder: Path
    on_this_machine: ClassVar[bool] = True

    def read(self) -> tuple[float, int] | None:
        """CPU time (s) and memory in use (bytes); None once the group is gone."""
        try:
            cpu_s = parse_flat((self.folder / "cpu.stat").read_text())["usage_usec"] * _US
            usage = int((self.folder / "memory.current").read_text())
            cache = file_cache_bytes(parse_flat((self.folder / "memory.stat").read_text()))
        except (OSError, ValueError, KeyError):
            return None
        return cpu_s, max(0, usage - cache)

    def totals(self) -> dict[str, float]:
        """Peaks (``memory.peak``, kernel 5.19; ``pids.peak``, 6.1), bytes of disks, and times in which tasks waited."""
        totals: dict[str, float | None] = {
            "ram.charged_max": _read_int(self.folder / "memory.peak"),
            "tasks.max": _read_int(self.folder / "pids.peak"),
        }
        with contextlib.suppress(OSError, ValueError):  # without the controller io
            totals |= parse_io((self.folder / "io.stat").read_text())
        with contextlib.suppress(OSError, ValueError, KeyError):  # without the controller cpu
            totals["cpu.throttled"] = parse_flat((self.folder / "cpu.stat").read_text())["throttled_usec"] * _US
        for resource in ("cpu", "memory", "io"):
            with contextlib.suppress(OSError, ValueError):  # a kernel that was booted without psi=1
                totals[f"stall.{resource}"] = parse_stall_s((self.folder / f"{resource}.pressure").read_text())
        return present(totals)

    def close(self) -> None:
        """Nothing is held open."""


Cgroup = CgroupV1 | CgroupV2


class TaskCounter:
    """Counts the processes and threads that the kernel refuses a group. The files are the same under both versions.

    Args:
        folder: The group under the controller ``pids``.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._refusals = 0

    def refused(self) -> bool:
        """Return whether a process was refused since the last call, or the group was refused one and is still full.

        Who was refused may wait for seconds before it tries again.
        """
        before = self._refusals
        try:
            self._refusals = parse_flat((self._folder / "pids.events").read_text()).get("max", 0)
            if self._refusals > before:
                return True
            limit = (self._folder / "pids.max").read_text().strip() if self._refusals else "max"
            return limit != "max" and int((self._folder / "pids.current").read_text()) >= int(limit)
        except (OSError, ValueError):
            return False


def cgroup_of(pid: int, container_id: str, root: Path = CGROUP_ROOT, proc: Path = Path("/proc")) -> Cgroup | None:
    """The control group of a container's first process; None if it is not on this machine or cannot be read.

    A worker in a container sees the control groups of the host, but not its processes: the group is then looked for
    by its name.

    Args:
        pid: As the engine reports it.
        container_id: Must occur in the group's path: a pid of another machine means nothing here.
        root: Where the control groups are mounted.
        proc: Where the process files are mounted.
    """
    group: Cgroup | None = None
    with contextlib.suppress(OSError):
        memberships = parse_memberships((proc / str(pid) / "cgroup").read_text())
        cpuacct, memory = memberships.get("cpuacct", ""), memberships.get("memory", "")
        if container_id in cpuacct and container_id in memory:
            group = CgroupV1(root / "cpuacct" / cpuacct.lstrip("/"), root / "memory" / memory.lstrip("/"))
        elif container_id in memberships.get("", "") and not cpuacct:
            group = CgroupV2(root / memberships[""].lstrip("/"))
    if group is None and (root / "cpuacct").is_dir():
        # Wherever the engine put it: in docker/<id> or system.slice/docker-<id>.scope, mostly.
        folders = [_find_folder(root / tree, container_id) for tree in ("cpuacct", "memory")]
        group = None if folders[0] is None or folders[1] is None else CgroupV1(folders[0], folders[1])
    elif group is None:
        folder = _find_folder(root, container_id)
        group = None if folder is None else CgroupV2(folder)
    return group if group is not None and group.read() is not None else None


def task_counter_of(
    pid: int, container_id: str, root: Path = CGROUP_ROOT, proc: Path = Path("/proc")
) -> TaskCounter | None:
    """The counter of a container's processes; None if its files are not on this machine. See :func:`cgroup_of`."""
    try:
        memberships = parse_memberships((proc / str(pid) / "cgroup").read_text())
    except OSError:
        memberships = {}
    tree = root / "pids" if (root / "pids").is_dir() else root
    path = memberships.get("pids", memberships.get("", ""))
    folder = tree / path.lstrip("/") if container_id in path else _find_folder(tree, container_id)
    return TaskCounter(folder) if folder is not None and (folder / "pids.events").exists() else None


def _find_folder(tree: Path, container_id: str) -> Path | None:
    for parent, folders, _ in os.walk(tree):
        for name in folders:
            if name in (container_id, f"docker-{container_id}.scope"):
                return Path(parent, name)
    return None


def parse_memberships(text: str) -> dict[str, str]:
    """``/proc/<pid>/cgroup``: {controller: path}; version 2 has the controller ``""``."""
    memberships: dict[str, str] = {}
    for line in text.splitlines():
        _, controllers, path = line.split(":", 2)
        memberships.update(dict.fromkeys(controllers.split(","), path))
    return memberships


def parse_flat(text: str) -> dict[str, int]:
    """A flat keyed file (``memory.stat``, ``cpu.stat``): {key: number}."""
    pairs = (line.split() for line in text.splitlines())
    return {pair[0]: int(pair[1]) for pair in pairs if len(pair) == 2}


def file_cache_bytes(stat: Mapping[str, int]) -> int:
    """The file cache in ``memory.stat`` of either version, without shared memory, which the kernel counts with it."""
    if "total_cache" in stat:
        return stat["total_cache"] - stat.get("total_shmem", 0)
    return stat.get("file", 0) - stat.get("shmem", 0)


def parse_io(text: str) -> dict[str, float | None]:
    """``io.stat``: the bytes that were read and written, over all devices. An empty file means none."""
    words = [word.partition("=") for line in text.splitlines() for word in line.split()[1:]]
    return {
        metric: float(sum(int(value) for name, _, value in words if name == key))
        for metric, key in (("io.read", "rbytes"), ("io.written", "wbytes"))
    }


def parse_stall_s(text: str) -> float:
    """A file of pressure stall information: the time (s) in which at least one task waited. Raises ValueError."""
    first = text.partition("\n")[0]
    name, _, total_us = first.rpartition(" total=")
    if not name.startswith("some "):
        raise ValueError(first)
    return int(total_us) * _US


def present(totals: Mapping[str, float | None]) -> dict[str, float]:
    """The totals that are known."""
    return {metric: float(value) for metric, value in totals.items() if value is not None}


def _read_int(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None
