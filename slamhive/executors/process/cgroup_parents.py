"""Where this process may make control groups for runs."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path

from slamhive.executors.cgroup import CGROUP_ROOT, parse_memberships
from slamhive.executors.process.containment_base import DoesNotHold

V1_CONTROLLERS = ("pids", "memory", "cpu", "cpuacct", "freezer")
V2_CONTROLLERS = ("pids", "memory", "cpu")


@dataclass(frozen=True, slots=True)
class Parents:
    """Where groups of runs are made: a folder for each controller that is available."""

    version: int
    folders: dict[str, Path]


def find_parents(root: Path = CGROUP_ROOT, own: Path = Path("/proc/self/cgroup")) -> Parents:
    """Where this process may make groups. Raises DoesNotHold.

    Args:
        root: Where the control groups are mounted.
        own: Names the groups of this process.
    """
    try:
        memberships = parse_memberships(own.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise DoesNotHold("this kernel has no control groups") from None
    if (root / "cgroup.controllers").exists():
        return Parents(2, dict.fromkeys(*_v2_parent(root, memberships.get("", "/"))))
    found = {name: _v1_parent(root / name, memberships.get(name, "/")) for name in V1_CONTROLLERS}
    folders = {name: folder for name, folder in found.items() if folder is not None}
    if "pids" not in folders:
        raise DoesNotHold(f"no group below {root}/pids can be made by this user")
    return Parents(1, folders)


def _v1_parent(tree: Path, own: str) -> Path | None:
    for folder in (tree / own.lstrip("/"), tree):
        if folder.is_dir() and os.access(folder, os.W_OK | os.X_OK):
            return folder
    return None


def _v2_parent(root: Path, own: str) -> tuple[list[str], Path]:
    """Controllers and folder of the nearest group that may have groups of runs in it."""
    start = root / own.lstrip("/")
    for folder in (start, *start.parents):
        if os.access(folder, os.W_OK | os.X_OK) and os.access(folder / "cgroup.procs", os.W_OK):
            enabled = _enable(folder)
            if "pids" in enabled:
                return enabled, folder
        if folder == root:
            break
    raise DoesNotHold(f"no group around {start} is delegated to this user with the controller pids")


def _enable(folder: Path) -> list[str]:
    """The controllers of groups below ``folder``. They are enabled unless somebody else manages them."""
    switch = folder / "cgroup.subtree_control"
    if "pids" not in switch.read_text(encoding="ascii").split():
        for controller in V2_CONTROLLERS:
            # Refused where processes are in the group itself, and where the group lacks the controller.
            with contextlib.suppress(OSError):
                switch.write_text(f"+{controller}", encoding="ascii")
    return [name for name in switch.read_text(encoding="ascii").split() if name in V2_CONTROLLERS]
