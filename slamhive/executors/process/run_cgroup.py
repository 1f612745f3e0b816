"""A control group for each run: the kernel enforces the limits and ends the run as a whole.

Version 1 has a tree for each controller, version 2 has one for all. Otherwise both work alike. Under version 1 the
group is below that of this process, so that an administrator's limits apply to runs too. Version 2 allows it only
beside this process: in the nearest group above that this user may write to (a delegated slice).
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from slamhive.clock import monotonic_s
from slamhive.executors.cgroup import CGROUP_ROOT, CgroupV1, CgroupV2, TaskCounter, parse_flat
from slamhive.executors.process.cgroup_parents import V1_CONTROLLERS, V2_CONTROLLERS, Parents
from slamhive.executors.process.containment_base import ContainmentRequest, DoesNotHold, Look, ProcessTree
from slamhive.executors.process.table import ProcessEntry, end_all, living, read_process
from slamhive.executors.refusal_watch import REFUSAL_PATIENCE_S
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


class RunCgroup:
    """The control group of one run.

    Args:
        version: Of the control groups.
        folders: The group's folder for each controller; under version 2 always the same.
        limited: The controllers that enforce a limit of the run.
    """

    kind = "cgroup"
    patience_s = REFUSAL_PATIENCE_S

    def __init__(self, version: int, folders: dict[str, Path], limited: frozenset[str] = frozenset()) -> None:
        self._version = version
        self._folders = folders
        self._tasks = folders["pids"]
        self._limited = limited
        self._counter = TaskCounter(folders["pids"])

    @property
    def holds_memory(self) -> bool:
        """Whether the kernel enforces the memory limit."""
        return "memory" in self._limited

    @property
    def holds_cpu(self) -> bool:
        """Whether the kernel enforces the limit of cores."""
        return "cpu" in self._limited

    @classmethod
    def make(cls, request: ContainmentRequest, parents: Parents) -> RunCgroup:
        """Make the group with its limits, and check that processes can enter it. Raises DoesNotHold."""
        name = group_name(request.installation, request.key)
        folders = {controller: parent / name for controller, parent in parents.folders.items()}
        try:
            for folder in folders.values():
                folder.mkdir(exist_ok=True)
            group = cls(parents.version, folders, _set_limits(parents.version, folders, request))
            group._try_to_enter()
        except OSError as error:
            cls(parents.version, folders).remove()
            raise DoesNotHold(f"{error.filename or folders['pids']}: {error.strerror}") from None
        return group

    @classmethod
    def found_again(cls, description: dict[str, Any]) -> RunCgroup | None:
        """The group that :meth:`describe` described; None if it is no group of a run."""
        folders = {controller: Path(folder) for controller, folder in description["folders"].items()}
        if not all(folder.name.startswith(PREFIX) and folder.is_absolute() for folder in folders.values()):
            return None
        return cls(description["version"], folders, frozenset(description["limited"]))

    def describe(self) -> dict[str, Any]:
        """See :class:`Containment`."""
        folders = {controller: str(folder) for controller, folder in self._folders.items()}
        return {"kind": self.kind, "version": self._version, "folders": folders, "limited": sorted(self._limited)}

    def words(self) -> dict[str, str]:
        """See :class:`Containment`."""
        v1 = self._version == 1
        memory = "memory.limit_in_bytes" if v1 else "memory.max"
        cpu = "cpu.cfs_quota_us" if v1 else "cpu.max"
        return {
            "held_by": f"control group, version {self._version}",
            "processes": "enforced by the kernel (pids.max)",
            "memory": f"enforced by the kernel ({memory})" if self.holds_memory else "checked by the supervisor",
            "cpu": f"enforced by the kernel ({cpu})" if self.holds_cpu else "bound to whole cores",
            "end": self._way_to_end(),
        }

    def enter(self) -> None:
        """See :class:`Containment`."""
        for folder in set(self._folders.values()):
            (folder / "cgroup.procs").write_text("0", encoding="ascii")

    def look(self, tree: ProcessTree) -> Look:  # noqa: ARG002 - the seam's signature
        """See :class:`Containment`."""
        oom_file = "memory.oom_control" if self._version == 1 else "memory.events"
        killed = self.holds_memory and self._count("memory", oom_file, "oom_kill") > 0
        return Look(self._counter.refused(), killed)

    def members(self) -> list[ProcessEntry]:
        """See :class:`Containment`."""
        try:
            pids = (self._tasks / "cgroup.procs").read_text(encoding="ascii").split()
        except OSError:
            return []
        return living(entry for pid in pids if (entry := read_process(int(pid))) is not None)

    def end(self, patience_s: float) -> bool:
        """See :class:`Containment`. At once, nothing new can start in the group."""
        self._try_to_write("pids", "pids.max", "0")
        if not self.members():
            return True
        if (self._tasks / "cgroup.kill").exists():
            self._try_to_write("pids", "cgroup.kill", "1")
        elif self._freeze():
            # Frozen processes use no CPU time, and receive their signals when they thaw.
            for entry in self.members():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(entry.pid, signal.SIGKILL)
            self._thaw()
        return end_all(self.members, patience_s)

    def remove(self) -> None:
        """See :class:`Containment`. A group that still holds processes stays."""
        deadline_s = monotonic_s() + _FREEZE_PATIENCE_S
        for folder in set(self._folders.values()):
            while not _remove_tree(folder) and monotonic_s() < deadline_s:
                time.sleep(_PAUSE_S)

    def usage(self) -> UsageSource | None:
        """See :class:`Containment`."""
        if self._version == 2:
            return CgroupV2(self._tasks) if {"memory", "cpu"} <= self._folders.keys() else None
        if {"memory", "cpuacct"} <= self._folders.keys():
            return CgroupV1(self._folders["cpuacct"], self._folders["memory"])
        return None

    def _try_to_enter(self) -> None:
        """Put an idle process into the group. Raises OSError."""
        probe = os.posix_spawnp("sleep", ["sleep", "60"], os.environ)
        try:
            for folder in set(self._folders.values()):
                (folder / "cgroup.procs").write_text(str(probe), encoding="ascii")
        finally:
            os.kill(probe, signal.SIGKILL)
            os.waitpid(probe, 0)

    def _way_to_end(self) -> str:
        if (self._tasks / "cgroup.kill").exists():
            return "the whole group is killed at once (cgroup.kill)"
        return (
            "the whole group is frozen, then killed" if self._freezer() else "the whole group is stopped, then killed"
        )

    def _freezer(self) -> Path | None:
        if self._version == 2:
            file = self._tasks / "cgroup.freeze"
        elif "freezer" in self._folders:
            file = self._folders["freezer"] / "freezer.state"
        else:
            return None
        return file if file.exists() else None

    def _freeze(self) -> bool:
        """Freeze the group; returns whether that worked. A process inside a system call may take a moment."""
        file = self._freezer()
        if file is None:
            return False
        deadline_s = monotonic_s() + _FREEZE_PATIENCE_S
        try:
            while monotonic_s() < deadline_s:
                file.write_text("FROZEN" if self._version == 1 else "1", encoding="ascii")
                if self._is_frozen(file):
                    return True
                time.sleep(_PAUSE_S)
        except OSError:
            return False
        return True

    def _is_frozen(self, file: Path) -> bool:
        if self._version == 1:
            return file.read_text(encoding="ascii").strip() == "FROZEN"
        return self._count("pids", "cgroup.events", "frozen") == 1

    def _thaw(self) -> None:
        file = self._freezer()
        if file is not None:
            with contextlib.suppress(OSError):
                file.write_text("THAWED" if self._version == 1 else "0", encoding="ascii")

    def _count(self, controller: str, file: str, key: str) -> int:
        """A counter of a flat keyed file; 0 where there is no such group, file or counter (any more)."""
        try:
            return parse_flat((self._folders[controller] / file).read_text(encoding="ascii")).get(key, 0)
        except (OSError, ValueError, KeyError):
            return 0

    def _try_to_write(self, controller: str, file: str, value: str) -> None:
        with contextlib.suppress(OSError):
            (self._folders[controller] / file).write_text(value, encoding="ascii")


def left_over_groups(installation: str, root: Path = CGROUP_ROOT) -> Iterator[tuple[str, RunCgroup]]:
    """(name, group) of all groups that were ever made for runs of this installation and are still there."""
    version = 2 if (root / "cgroup.controllers").exists() else 1
    start = _slug(f"{PREFIX}{installation[:12]}-")
    controllers = V2_CONTROLLERS if version == 2 else V1_CONTROLLERS
    trees = {controller: root if version == 2 else root / controller for controller in controllers}
    found: dict[str, dict[str, Path]] = {}
    for controller, tree in trees.items():
        for parent, names, _ in os.walk(tree):
            for name in names:
                if name.startswith(start):
                    found.setdefault(name, {})[controller] = Path(parent, name)
    for name, folders in found.items():
        yield name, RunCgroup(version, {"pids": next(iter(folders.values())), **folders})


def _set_limits(version: int, folders: dict[str, Path], request: ContainmentRequest) -> frozenset[str]:
    """Set the limits that are asked for; the controllers that can hold one. Raises OSError if ``pids`` cannot."""
    _write(folders["pids"] / "pids.max", request.tasks)
    limited = {"pids"}
    for controller, set_limit in (("memory", _limit_memory), ("cpu", _limit_cpu)):
        if controller in folders:
            with contextlib.suppress(OSError):
                set_limit(version, folders[controller], request)
                limited.add(controller)
    return frozenset(limited)


def _limit_memory(version: int, folder: Path, request: ContainmentRequest) -> None:
    """Memory and swap together, as for containers. A kernel without accounting of swap limits memory alone."""
    unlimited = "-1" if version == 1 else "max"
    limit = unlimited if request.memory_bytes is None else request.memory_bytes
    _write(folder / ("memory.limit_in_bytes" if version == 1 else "memory.max"), limit)
    with contextlib.suppress(OSError):
        if version == 1:
            _write(folder / "memory.memsw.limit_in_bytes", limit)
        else:
            _write(folder / "memory.swap.max", unlimited if request.memory_bytes is None else 0)


def _limit_cpu(version: int, folder: Path, request: ContainmentRequest) -> None:
    quota_us = None if request.cpu_cores is None else round(request.cpu_cores * _PERIOD_US)
    if version == 2:
        _write(folder / "cpu.max", f"{'max' if quota_us is None else quota_us} {_PERIOD_US}")
        return
    _write(folder / "cpu.cfs_period_us", _PERIOD_US)
    _write(folder / "cpu.cfs_quota_us", -1 if quota_us is None else quota_us)


def _write(path: Path, value: int | str) -> None:
    """Into a file that the kernel has made: without one there is no such control."""
    with path.open("r+", encoding="ascii") as stream:
        stream.write(str(value))


def _remove_tree(folder: Path) -> bool:
    """Remove a group and those that were made inside of it; whether it is gone."""
    for parent, _, _ in os.walk(folder, topdown=False):
        with contextlib.suppress(OSError):
            Path(parent).rmdir()
    return not folder.exists()
