"""The control group in which this process may make one group for each run: its home.

Under version 1 that is the process's own group in the tree of each controller. Under version 2 the kernel gives the
members of a group no controllers of their own as long as the group holds processes itself ("no internal processes",
``Documentation/admin-guide/cgroup-v2.rst``). So the home is cut in two::

    slamhive-worker.service      the unit that systemd delegated: the home
    ├─ slamhive.main             the worker, its supervisors, and whatever else was in the unit
    ├─ slamhive-3f2a…-run-7      one run, with its limits
    └─ slamhive-3f2a…-run-8

:func:`find_home` only looks. :func:`settle` makes the cut, and is called by a supervisor just before its run starts.

Systemd decides who may do this, not file permissions. The manager of a unit that it has not delegated takes its
controllers back whenever it likes (https://systemd.io/CGROUP_DELEGATION).

A process in such a unit starts its supervisors in a scope of their own (:mod:`slamhive.executors.process.cgroup_home`).
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from slamhive.executors.cgroup import CGROUP_ROOT, parse_memberships
from slamhive.executors.process.containment_base import DoesNotHold

OWN_GROUP = Path("/proc/self/cgroup")
LEAF = "slamhive.main"
"""The group below the home for processes that are not runs. ``DelegateSubgroup=`` of the shipped units names it too."""
V1_CONTROLLERS = ("pids", "memory", "cpu", "cpuacct", "freezer")
V2_CONTROLLERS = ("memory", "pids", "cpu", "io")
_ANSWER_S = 30.0
_ROUNDS = 100
"""A home that programs keep filling faster than it is emptied is given up after so many tries."""


@dataclass(frozen=True, slots=True)
class CgroupHome:
    """Where groups of runs are made.

    Attributes:
        version: Of the control groups.
        folders: The folder in which groups are made, for each controller that is there. The same for all in version 2.
        settled: Whether groups can be made without moving a process or enabling a controller.
    """

    version: int
    folders: dict[str, Path]
    settled: bool = True

    @property
    def folder(self) -> Path:
        """The folder of the controller ``pids``, which every home has."""
        return self.folders["pids"]

    @property
    def name(self) -> str:
        """The unit or group, for the user."""
        return self.folder.name if (self.folder / "cgroup.type").exists() else "the root group"


def find_home(root: Path = CGROUP_ROOT, own: Path = OWN_GROUP, *, own_scope: bool = False) -> CgroupHome:
    """Look for the home of this process, and change nothing. Raises DoesNotHold with the reason.

    Args:
        root: Where the control groups are mounted.
        own: Names the groups of this process.
        own_scope: Whether the unit was made for this process, so that it need not be marked as delegated:
            the manager of a user does not mark it.
    """
    try:
        memberships = parse_memberships(own.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise DoesNotHold("this kernel has no control groups") from None
    if (root / "cgroup.controllers").exists():
        group = root / memberships.get("", "/").lstrip("/")
        home = group.parent if group.name == LEAF else group
        files = (home / "cgroup.procs", home / "cgroup.subtree_control")
        if not os.access(home, os.W_OK | os.X_OK) or not all(os.access(file, os.W_OK) for file in files):
            raise DoesNotHold(f"this user may not change the control group {_shown(home, root)}")
        if home.suffix in (".service", ".scope") and not own_scope and not _is_delegated(home, root):
            raise DoesNotHold(f"systemd has not delegated {home.name} (Delegate=yes)")
        available = (home / "cgroup.controllers").read_text(encoding="ascii").split()
        controllers = [name for name in V2_CONTROLLERS if name in available]
        if "pids" not in controllers:
            raise DoesNotHold(f"{_shown(home, root)} has no controller pids, only {' '.join(available) or 'none'}")
        enabled = _enabled(home)
        # A group whose threaded controllers alone are enabled may hold processes, but then no run can enter a group in
        # it.
        settled = "pids" in enabled and ("memory" in enabled or "memory" not in controllers) and not _is_threaded(home)
        return CgroupHome(2, dict.fromkeys(enabled if settled else controllers, home), settled)

    folders: dict[str, Path] = {}
    for name in V1_CONTROLLERS:
        # The nearest folder that this user may make groups in: the limits of an administrator then hold runs too.
        for folder in (root / name / memberships.get(name, "/").lstrip("/"), root / name):
            if folder.is_dir() and os.access(folder, os.W_OK | os.X_OK):
                folders[name] = folder
                break
    if "pids" not in folders:
        raise DoesNotHold(f"this user cannot make a group below {root}/pids")
    return CgroupHome(1, folders)


def _shown(folder: Path, root: Path) -> str:
    return "/" if folder == root else f"/{folder.relative_to(root)}"


def _is_delegated(unit: Path, root: Path) -> bool:
    """Return whether systemd gave this unit's group away. It marks the group, and gives its files to the user."""
    for mark in ("user.delegate", "trusted.delegate"):
        with contextlib.suppress(OSError):  # not set, not readable for this user, or no such attributes in this kernel
            return os.getxattr(unit, mark) == b"1"
    if any(part.startswith("user@") for part in unit.relative_to(root).parts):
        # Below a user's manager all files are the user's, and the manager of systemd 252 sets no marks.
        return _manager_says_delegated(unit.name)
    return os.geteuid() != 0


@cache
def _manager_says_delegated(unit: str) -> bool:
    """Return whether the manager of this user has delegated the unit. That does not change while the unit lives."""
    options, variables = manager_of_user(os.geteuid(), os.environ)
    command = ["systemctl", *(options or ["--user"]), "show", "--property=Delegate", "--value", unit]
    try:
        said = subprocess.run(
            command, env={**os.environ, **variables}, capture_output=True, text=True, check=False, timeout=_ANSWER_S
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return said.stdout.strip() == "yes"


def manager_of_user(uid: int, environment: Mapping[str, str]) -> tuple[list[str], dict[str, str]]:
    """Options and variables by which programs of systemd reach the manager of ``uid``.

    A system service with ``User=`` and a shell of su lack the variable, though a lingering user has a manager.
    """
    if uid == 0:
        return [], {}
    folder = environment.get("XDG_RUNTIME_DIR", f"/run/user/{uid}")
    bus = environment.get("DBUS_SESSION_BUS_ADDRESS")
    return ["--user"], {"XDG_RUNTIME_DIR": folder} | ({} if bus is None else {"DBUS_SESSION_BUS_ADDRESS": bus})


def _enabled(folder: Path) -> list[str]:
    text = (folder / "cgroup.subtree_control").read_text(encoding="ascii").split()
    return [name for name in V2_CONTROLLERS if name in text]


def _is_threaded(folder: Path) -> bool:
    try:
        return "threaded" in (folder / "cgroup.type").read_text(encoding="ascii")
    except OSError:  # the root of all groups has no type
        return False


def settle(home: CgroupHome) -> CgroupHome:
    """Make ``home`` ready for groups of runs: empty it into its leaf, and enable its controllers. Raises DoesNotHold.

    Several supervisors may do so at once: every step may have been made before.
    """
    if home.settled:
        return home
    try:
        _empty_and_enable(home)
    except OSError as error:
        raise DoesNotHold(f"{error.filename or home.folder}: {error.strerror}") from None
    enabled = [name for name in _enabled(home.folder) if name in home.folders]
    if "pids" not in enabled:
        raise DoesNotHold(f"the kernel does not enable the controller pids below {home.folder}")
    return replace(home, folders=dict.fromkeys(enabled, home.folder), settled=True)


def _empty_and_enable(home: CgroupHome) -> None:
    folder = home.folder
    # One write for all. With memory among them the kernel refuses it (EBUSY) while the group holds a process. Without,
    # pids and cpu would be taken even then, and would turn the group into a threaded one that no run can live in.
    order = " ".join(f"+{controller}" for controller in home.folders)
    if not (folder / "cgroup.type").exists():  # the root of all groups may hold processes beside groups
        (folder / "cgroup.subtree_control").write_text(order, encoding="ascii")
        return
    leaf = folder / LEAF
    leaf.mkdir(exist_ok=True)
    for _ in range(_ROUNDS):
        if _is_threaded(folder):
            # Threaded controllers were enabled while the group held processes: take them back.
            for controller in _enabled(folder):
                with contextlib.suppress(OSError):  # a group of a run below still uses it
                    (folder / "cgroup.subtree_control").write_text(f"-{controller}", encoding="ascii")
        pids = (folder / "cgroup.procs").read_text(encoding="ascii").split()
        if "0" in pids:  # to write 0 would move this process
            raise DoesNotHold(f"{folder} holds processes from outside of this container")
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):  # it has ended
                (leaf / "cgroup.procs").write_text(pid, encoding="ascii")
        if pids:
            continue  # who was moved may have started another one just before
        try:
            (folder / "cgroup.subtree_control").write_text(order, encoding="ascii")
        except OSError as error:
            if error.errno != errno.EBUSY:
                raise
        else:
            if not _is_threaded(folder):
                return
    raise DoesNotHold(f"{folder} never became empty: something starts processes in it all the time")


def smallest_limit_above(home: CgroupHome, file: str, root: Path = CGROUP_ROOT) -> tuple[str, int] | None:
    """The smallest limit of the groups around the runs: the group's name and the limit; None if there is none.

    Args:
        home: Where the groups of runs are.
        file: ``pids.max`` or ``memory.max``; version 1 is not asked.
        root: Where the control groups are mounted.
    """
    return _smallest_limit(home.folder, file, root) if home.version == 2 else None


def smallest_limit_around(file: str, root: Path = CGROUP_ROOT, own: Path = OWN_GROUP) -> tuple[str, int] | None:
    """The same for the groups of this process, which it need not be able to change: a job of Slurm is in such a one.

    ``own`` names the groups of this process.
    """
    try:
        memberships = parse_memberships(own.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return _smallest_limit(root / memberships.get("", "/").lstrip("/"), file, root)


def _smallest_limit(folder: Path, file: str, root: Path) -> tuple[str, int] | None:
    """Of several groups with the same limit, the outermost is named: that of a job, not of a step in it."""
    limits = []
    around = [group for group in (folder, *folder.parents) if group.is_relative_to(root) and group != root]
    for group in reversed(around):
        with contextlib.suppress(OSError, ValueError):  # no such controller there, or "max"
            limits.append((group.name, int((group / file).read_text(encoding="ascii"))))
    return min(limits, key=lambda limit: limit[1], default=None)


# A scope of its own for a supervisor, where systemd manages this process in a unit that it has not delegated.
#
# That is the case in an ssh session, on a desktop, and in a service without ``Delegate=yes``. The manager of this
# user, or that of the machine for root, makes the scope, and the supervisor makes the group of its run in there. The
# worker stays where it is. The scope ends with its last process.


OWN_SCOPE = "--own-scope"
NO_SCOPE = "--no-scope"
"""Arguments of programs that are started by :func:`run_in_scope`."""
_RUNNING_SYSTEMD = Path("/run/systemd/system")


def scope_wanted(root: Path = CGROUP_ROOT, systemd: Path = _RUNNING_SYSTEMD) -> bool:
    """Return whether only systemd can give this process a group to make others in. Only looks.

    Args:
        root: Where the control groups are mounted. Version 1 is used without systemd's help.
        systemd: The folder that is there if systemd runs this machine.
    """
    if not systemd.is_dir() or not (root / "cgroup.controllers").exists():
        return False
    try:
        find_home(root)
    except DoesNotHold:
        return True
    return False


def run_in_scope(command: Sequence[str], environment: Mapping[str, str], output: int) -> str | None:
    """Run ``command`` in a scope, with the argument ``--own-scope``; why that failed, or None.

    Args:
        command: A program that forks, or ends soon.
        environment: Its variables. Those that lead to the user's manager are added.
        output: The file descriptor for what it prints.
    """
    program = shutil.which("systemd-run")
    if program is None:
        return "systemd-run is missing"
    manager, variables = manager_of_user(os.geteuid(), os.environ)
    arguments = ["--scope", "--quiet", "--collect", "--property=Delegate=yes", "--description=SLAM Hive run", "--"]
    words = [program, *manager, *arguments, *command, OWN_SCOPE]
    start = os.lseek(output, 0, os.SEEK_CUR)
    try:
        ended = subprocess.run(
            words,
            env={**environment, **variables},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            cwd="/",
            check=False,
            timeout=_ANSWER_S,
        )
    except subprocess.TimeoutExpired:
        return f"systemd-run did not answer within {_ANSWER_S:.0f} s"
    if ended.returncode == 0:
        return None
    said = os.pread(output, os.lseek(output, 0, os.SEEK_CUR) - start, start).decode(errors="replace").strip()
    return said.splitlines()[-1] if said else f"systemd-run ended with {ended.returncode}"
