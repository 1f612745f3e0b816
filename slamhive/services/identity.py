"""Who holds a run: a name for this process that says when another process may be taken for dead."""

from __future__ import annotations

import os
import platform
import uuid
from pathlib import Path

from slamhive.executors.process.shim import process_birth

_UNKNOWN = "unknown"
_PID_NAMESPACE = Path("/proc/self/ns/pid")


def worker_identity() -> str:
    """``host:pid namespace:pid:boot:start``, different for any two processes of any two machines.

    The boot tells machines (and containers on them) apart that were given the same host name; the start, in clock
    ticks since that boot, tells processes apart that were given the same pid.
    """
    pid = os.getpid()
    birth = process_birth(pid) or f"{_UNKNOWN}:{uuid.uuid4().hex}"
    return f"{_host()}:{_pid_namespace()}:{pid}:{birth}"


def owner_is_dead(owner: str) -> bool:
    """Whether ``owner`` was a process of this boot and pid namespace that runs no more. False if that is not known."""
    try:
        host, namespace, pid_text, boot, start = owner.rsplit(":", 4)
        pid = int(pid_text)
    except ValueError:
        return False
    ours = process_birth(os.getpid())
    if ours is None or (host, namespace, boot) != (_host(), _pid_namespace(), ours.partition(":")[0]):
        return False
    birth = process_birth(pid)
    if birth is None:
        return not _hidden(pid)
    return birth != f"{boot}:{start}"


def _host() -> str:
    return platform.node() or "host"


def _pid_namespace() -> str:
    """The number of the space that this process's pids belong to: in another one they mean other processes."""
    try:
        return str(_PID_NAMESPACE.stat().st_ino)
    except OSError:
        return _UNKNOWN


def _hidden(pid: int) -> bool:
    """Whether there is such a process although ``/proc`` does not show it (another user's, under ``hidepid``)."""
    try:
        os.kill(pid, 0)
    except PermissionError:
        return True
    except (ProcessLookupError, OverflowError):
        return False
    return False
