"""A description of this machine, for the provenance of each run."""

from __future__ import annotations

import contextlib
import os
import platform
import uuid
from pathlib import Path

import psutil

from slamhive.domain.run import Host
from slamhive.executors.process.table import process_birth


def describe_host() -> Host:
    """Describe this machine; ``cpu_count`` counts logical cores."""
    models: list[str] = []
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    try:
        system = platform.freedesktop_os_release().get("PRETTY_NAME", platform.system())
    except OSError:
        system = platform.system()
    return Host(
        cpu_model=models[0] if models else platform.processor() or platform.machine(),
        cpu_count=os.cpu_count() or 1,
        memory_bytes=int(psutil.virtual_memory().total),
        kernel=platform.release(),
        os=system,
    )


# The name under which a process holds runs and containers; it lets others detect that the process is dead.


_UNKNOWN = "unknown"
_PID_NAMESPACE = Path("/proc/self/ns/pid")


def worker_identity() -> str:
    """``host:pid namespace:pid:boot:start``, unique for each process on each machine.

    The boot id distinguishes machines (and their containers) with the same host name. The start time
    (in kernel clock units since boot) distinguishes processes that were given the same pid.
    """
    pid = os.getpid()
    birth = process_birth(pid) or f"{_UNKNOWN}:{uuid.uuid4().hex}"
    return f"{_host()}:{_pid_namespace()}:{pid}:{birth}"


def owner_is_dead(owner: str) -> bool:
    """Return whether ``owner`` was a process of this boot and pid namespace and has ended. False if unknown."""
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
    """The identifier of this process's pid namespace: in another one, the same pid is another process."""
    try:
        return str(_PID_NAMESPACE.stat().st_ino)
    except OSError:
        return _UNKNOWN


def _hidden(pid: int) -> bool:
    """Return whether the process exists although ``/proc`` hides it (another user's process under ``hidepid``)."""
    try:
        os.kill(pid, 0)
    except PermissionError:
        return True
    except (ProcessLookupError, OverflowError):
        return False
    return False
