"""A control group for each run: the kernel enforces the limits and ends the run as a whole.

Version 1 has a tree for each controller, version 2 has one for all. Groups are made in the home of the supervisor, see
:mod:`slamhive.executors.process.cgroup_home`, so that an administrator's limits on its unit apply to runs too.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

from slamhive.base.clock import monotonic_s
from slamhive.executors.cgroup import CGROUP_ROOT, CgroupV1, CgroupV2, TaskCounter, parse_flat
from slamhive.executors.process.cgroup_home import V1_CONTROLLERS, V2_CONTROLLERS, CgroupHome, smallest_limit_above
from slamhive.executors.process.containment_base import (
    WHOLE_CORES,
    ContainmentLook,
    ContainmentRequest,
    DoesNotHold,
    ProcessTree,
)
from slamhive.executors.process.table import ProcessEntry, end_all, living, read_process
from slamhive.executors.refusals import REFUSAL_PATIENCE_S
from slamhive.executors.status import UsageSource

PREFIX = "slamhive-"
_PERIOD_US = 100_000
_FREEZE_PATIENCE_S = 0.5
_PAUSE_S = 0.005


def group_name(installation: str, key: str) -> str:
    """The name of a run's group."""
    return _slug(f"{PREFIX}{installation[:12]}-{key}")


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "_", text)


class RunCgroup(ABC):
    """The control group of one run.

    Args:
        folders: The group's folder for each controller; under version 2 always the same.
        limited: What the kernel limits: ``pids``, ``memory``, ``swap``, ``cpu``.
        place: The unit or group that it is in, for the user.
        above: Limits of groups above that are smaller than the run's own: {controller: words}.
    """

    kind = "cgroup"
    version: ClassVar[int]
    patience_s = REFUSAL_PATIENCE_S

    memory_file: ClassVar[str]
    cpu_file: ClassVar[str]
    oom_file: ClassVar[str]

    def __init__(
        self,
        folders: dict[str, Path],
        limited: frozenset[str] = frozenset(),
        place: str = "",
        above: dict[str, str] | None = None,
    ) -> None:
        self._folders = folders
        self._tasks = folders["pids"]
        self._limited = limited
        self._place = place
        self._above = above or {}
        self._counter = TaskCounter(folders["pids"])

    @property
    def holds_memory(self) -> bool:
        """Return whether the kernel enforces the memory limit."""
        return "memory" in self._limited

    @property
    def holds_cpu(self) -> bool:
        """Return whether the kernel enforces the limit of cores."""
        return "cpu" in self._limited

    @staticmethod
    def make(request: ContainmentRequest, home: CgroupHome) -> RunCgroup:
        """Make the group with its limits, and check that processes can enter it. Raises DoesNotHold."""
        name = group_name(request.installation, request.key)
        folders = {controller: parent / name for controller, parent in home.folders.items()}
        kind = VERSIONS[home.version]
        try:
            for folder in folders.values():
                folder.mkdir(exist_ok=True)
            limited = kind(folders)._set_limits(request)
            group = kind(folders, limited, place_of(home, request), limits_above(home, request))
            # Only a process that enters shows that others can: the rights on the files do not say so.
            probe = os.posix_spawnp("sleep", ["sleep", "60"], os.environ)
            try:
                for folder in set(folders.values()):
                    (folder / "cgroup.procs").write_text(str(probe), encoding="ascii")
            finally:
                os.kill(probe, signal.SIGKILL)
                os.waitpid(probe, 0)
        except OSError as error:
            kind(folders).remove()
            raise DoesNotHold(f"{error.filename or folders['pids']}: {error.strerror}") from None
        return group

    @staticmethod
    def foreseen(request: ContainmentRequest, home: CgroupHome) -> RunCgroup:
        """The group as far as a look at its home shows it, for :meth:`words` alone. Nothing is made."""
        limited = frozenset(home.folders) & {"pids", "memory", "cpu"}
        swap = {"swap"} if "memory" in limited and (home.folder / "memory.swap.max").exists() else set()
        # The home has the same files as a group in it will have, such as cgroup.kill.
        place = place_of(home, request)
        return VERSIONS[home.version](home.folders, limited | swap, place, limits_above(home, request))

    @staticmethod
    def found_again(description: dict[str, Any]) -> RunCgroup | None:
        """The group that :meth:`describe` described; None if it is no group of a run."""
        folders = {controller: Path(folder) for controller, folder in description["folders"].items()}
        if not all(folder.name.startswith(PREFIX) and folder.is_absolute() for folder in folders.values()):
            return None
        return VERSIONS[description["version"]](folders, frozenset(description["limited"]))

    def describe(self) -> dict[str, Any]:
        """Implement :class:`Containment`."""
        folders = {controller: str(folder) for controller, folder in self._folders.items()}
        return {"kind": self.kind, "version": self.version, "folders": folders, "limited": sorted(self._limited)}

    def words(self) -> dict[str, str]:
        """Implement :class:`Containment`."""
        memory = "checked by the supervisor"
        if self.holds_memory:
            swap = "swap included" if "swap" in self._limited else "but not swap, which this kernel does not count"
            memory = f"enforced by the kernel ({self.memory_file}), {swap}{self._above.get('memory', '')}"
        end = "the whole group is stopped, then killed"
        if (self._tasks / "cgroup.kill").exists():
            end = "the whole group is killed at once (cgroup.kill)"
        elif self._freezer():
            end = "the whole group is frozen, then killed"
        return {
            "held_by": f"control group, version {self.version}" + (f", in {self._place}" if self._place else ""),
            "processes": f"enforced by the kernel (pids.max){self._above.get('pids', '')}",
            "memory": memory,
            "cpu": f"enforced by the kernel ({self.cpu_file})" if self.holds_cpu else WHOLE_CORES,
            "end": end,
        }

    def enter(self) -> None:
        """Implement :class:`Containment`."""
        for folder in set(self._folders.values()):
            (folder / "cgroup.procs").write_text("0", encoding="ascii")

    def look(self, tree: ProcessTree) -> ContainmentLook:  # noqa: ARG002 - the seam's signature
        """Implement :class:`Containment`."""
        killed = self.holds_memory and self._count("memory", self.oom_file, "oom_kill") > 0
        return ContainmentLook(self._counter.refused(), killed)

    def members(self) -> list[ProcessEntry]:
        """Implement :class:`Containment`. A run of the same user may have made groups in its group."""
        pids: list[str] = []
        for parent, _, _ in os.walk(self._tasks):
            with contextlib.suppress(OSError):  # it is gone by now
                pids += Path(parent, "cgroup.procs").read_text(encoding="ascii").split()
        return living(entry for pid in pids if (entry := read_process(int(pid))) is not None)

    def end(self, patience_s: float) -> bool:
        """Implement :class:`Containment`. At once, nothing new can start in the group."""
        self._try_to_write("pids", "pids.max", "0")
        if not self.members():
            return True
        # Kernels before 5.14 have no cgroup.kill: members are frozen first if possible, so that none escapes by a fork.
        if (self._tasks / "cgroup.kill").exists():
            self._try_to_write("pids", "cgroup.kill", "1")
        elif self._freeze():
            # Frozen processes use no CPU time, and receive their signals when they thaw.
            for entry in self.members():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(entry.pid, signal.SIGKILL)
            file = self._freezer()
            if file is not None:
                with contextlib.suppress(OSError):
                    file.write_text(self.thawed_word, encoding="ascii")
        return end_all(self.members, patience_s)

    def remove(self) -> None:
        """Implement :class:`Containment`. A group that still holds processes stays."""
        deadline_s = monotonic_s() + _FREEZE_PATIENCE_S
        for folder in set(self._folders.values()):
            while True:
                # A run may have made groups inside of its own.
                for parent, _, _ in os.walk(folder, topdown=False):
                    with contextlib.suppress(OSError):
                        Path(parent).rmdir()
                if not folder.exists() or monotonic_s() >= deadline_s:
                    break
                time.sleep(_PAUSE_S)

    @abstractmethod
    def usage(self) -> UsageSource | None:
        """Implement :class:`Containment`."""

    @abstractmethod
    def _limit_memory(self, folder: Path, limit_bytes: int | None) -> bool:
        """Limit memory and swap together, as for containers; whether the kernel counts swap. Raises OSError."""

    @abstractmethod
    def _limit_cpu(self, folder: Path, quota_us: int | None) -> None:
        """Allow ``quota_us`` of CPU time in each period. Raises OSError."""

    @abstractmethod
    def _freezer(self) -> Path | None:
        """The file that freezes the group; None without one."""

    @abstractmethod
    def _is_frozen(self, file: Path) -> bool: ...

    frozen_word: ClassVar[str]
    thawed_word: ClassVar[str]

    def _set_limits(self, request: ContainmentRequest) -> frozenset[str]:
        """Set the limits, and return which of them the kernel holds. Raises OSError if ``pids`` is not one."""
        _write(self._tasks / "pids.max", request.tasks)
        limited = {"pids"}
        if "memory" in self._folders:
            with contextlib.suppress(OSError):
                counts_swap = self._limit_memory(self._folders["memory"], request.memory_bytes)
                limited |= {"memory", "swap"} if counts_swap else {"memory"}
        if "cpu" in self._folders:
            quota_us = None if request.cpu_cores is None else round(request.cpu_cores * _PERIOD_US)
            with contextlib.suppress(OSError):
                self._limit_cpu(self._folders["cpu"], quota_us)
                limited.add("cpu")
        return frozenset(limited)

    def _freeze(self) -> bool:
        """Freeze the group; returns whether that worked. A process inside a system call may take a moment."""
        file = self._freezer()
        if file is None:
            return False
        deadline_s = monotonic_s() + _FREEZE_PATIENCE_S
        try:
            while monotonic_s() < deadline_s:
                file.write_text(self.frozen_word, encoding="ascii")
                if self._is_frozen(file):
                    return True
                time.sleep(_PAUSE_S)
        except OSError:
            return False
        return True  # not in time: what is stopped by now is killed all the same

    def _count(self, controller: str, file: str, key: str) -> int:
        """A counter of a flat keyed file; 0 where there is no such group, file or counter (any more)."""
        try:
            return parse_flat((self._folders[controller] / file).read_text(encoding="ascii")).get(key, 0)
        except (OSError, ValueError, KeyError):
            return 0

    def _try_to_write(self, controller: str, file: str, value: str) -> None:
        with contextlib.suppress(OSError):
            (self._folders[controller] / file).write_text(value, encoding="ascii")


class RunCgroupV1(RunCgroup):
    """One folder in the tree of each controller."""

    version = 1
    memory_file, cpu_file, oom_file = "memory.limit_in_bytes", "cpu.cfs_quota_us", "memory.oom_control"
    frozen_word, thawed_word = "FROZEN", "THAWED"

    def usage(self) -> UsageSource | None:
        """Implement :class:`Containment`."""
        if {"memory", "cpuacct"} <= self._folders.keys():
            return CgroupV1(self._folders["cpuacct"], self._folders["memory"])
        return None

    def _limit_memory(self, folder: Path, limit_bytes: int | None) -> bool:
        limit = -1 if limit_bytes is None else limit_bytes
        _write(folder / "memory.limit_in_bytes", limit)
        try:
            _write(folder / "memory.memsw.limit_in_bytes", limit)
        except OSError:  # the kernel was booted without swapaccount=1
            return False
        return True

    def _limit_cpu(self, folder: Path, quota_us: int | None) -> None:
        _write(folder / "cpu.cfs_period_us", _PERIOD_US)
        _write(folder / "cpu.cfs_quota_us", -1 if quota_us is None else quota_us)

    def _freezer(self) -> Path | None:
        file = self._folders["freezer"] / "freezer.state" if "freezer" in self._folders else None
        return file if file is not None and file.exists() else None

    def _is_frozen(self, file: Path) -> bool:
        return file.read_text(encoding="ascii").strip() == "FROZEN"


class RunCgroupV2(RunCgroup):
    """One folder for all controllers.

    ``memory.high`` is left at ``max``, because it would slow a run down before its limit. A run that is measured should
    be as fast as it can be until it is ended.
    """

    version = 2
    memory_file, cpu_file, oom_file = "memory.max", "cpu.max", "memory.events"
    frozen_word, thawed_word = "1", "0"

    def usage(self) -> UsageSource | None:
        """Implement :class:`Containment`. ``cpu.stat`` counts CPU time without the controller ``cpu`` too."""
        return CgroupV2(self._tasks) if "memory" in self._folders else None

    def _limit_memory(self, folder: Path, limit_bytes: int | None) -> bool:
        _write(folder / "memory.max", "max" if limit_bytes is None else limit_bytes)
        # An algorithm that has lost one of its processes goes on with less: no result is better than that one.
        self._try_to_write("memory", "memory.oom.group", "1")
        try:
            _write(folder / "memory.swap.max", "max" if limit_bytes is None else 0)
        except OSError:  # a kernel without accounting of swap
            return False
        return True

    def _limit_cpu(self, folder: Path, quota_us: int | None) -> None:
        _write(folder / "cpu.max", f"{'max' if quota_us is None else quota_us} {_PERIOD_US}")

    def _freezer(self) -> Path | None:
        file = self._tasks / "cgroup.freeze"
        return file if file.exists() else None

    def _is_frozen(self, file: Path) -> bool:  # noqa: ARG002 - version 1 reads it from the file itself
        return self._count("pids", "cgroup.events", "frozen") == 1


VERSIONS: dict[int, type[RunCgroup]] = {1: RunCgroupV1, 2: RunCgroupV2}


def place_of(home: CgroupHome, request: ContainmentRequest) -> str:
    """Where the group is, for the user; empty for version 1, which has a place for each controller."""
    if home.version == 1:
        return ""
    return "a scope of its own" if request.own_scope else home.name


def limits_above(home: CgroupHome, request: ContainmentRequest) -> dict[str, str]:
    """Words for the smallest limits above that a run would meet before its own: {controller: words}."""
    words = {}
    if (tasks := smallest_limit_above(home, "pids.max", CGROUP_ROOT)) is not None and tasks[1] < request.tasks:
        words["pids"] = f"; {tasks[0]} allows {tasks[1]} in all"
    memory = smallest_limit_above(home, "memory.max", CGROUP_ROOT)
    if memory is not None and request.memory_bytes is not None and memory[1] < request.memory_bytes:
        words["memory"] = f"; {memory[0]} allows {memory[1] / 1e6:.0f} MB in all"
    return words


def left_over_groups(installation: str, root: Path = CGROUP_ROOT) -> Iterator[tuple[str, RunCgroup]]:
    """(name, group) of all groups that were ever made for runs of this installation and are still there."""
    version = 2 if (root / "cgroup.controllers").exists() else 1
    start = _slug(f"{PREFIX}{installation[:12]}-")
    # All controllers of version 2 share one tree, so one walk finds all groups.
    trees = {"pids": root} if version == 2 else {controller: root / controller for controller in V1_CONTROLLERS}
    found: dict[str, dict[str, Path]] = {}
    for controller, tree in trees.items():
        for parent, names, _ in os.walk(tree):
            for name in names:
                if name.startswith(start):
                    found.setdefault(name, {})[controller] = Path(parent, name)
    for name, folders in found.items():
        any_folder = next(iter(folders.values()))
        all_folders = dict.fromkeys(V2_CONTROLLERS, any_folder) if version == 2 else {"pids": any_folder, **folders}
        yield name, VERSIONS[version](all_folders)


def _write(path: Path, value: int | str) -> None:
    """Write into a file that the kernel has made: without one there is no such control."""
    with path.open("r+", encoding="ascii") as stream:
        stream.write(str(value))
