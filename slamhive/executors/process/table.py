"""Lists the processes of this machine from ``/proc``, and ends a set of them so that none escapes."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from slamhive.base.clock import monotonic_s
from slamhive.base.machine import boot_id

_PROC = Path("/proc")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_STOP_PATIENCE_S = 2.0
_PAUSE_S = 0.005


@dataclass(frozen=True, slots=True)
class ProcessEntry:
    """A process: its parent, process group, number of threads, resident memory and the name of its program.

    A zombie has ended but was not reaped by its parent; the kernel still counts it.
    """

    pid: int
    parent: int
    group: int
    threads: int
    resident_bytes: int
    zombie: bool = False
    name: str = ""


def read_process(pid: int) -> ProcessEntry | None:
    """The process with this pid; None if there is none any more."""
    try:
        text = (_PROC / str(pid) / "stat").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError, PermissionError):
        return None
    before, _, after = text.rpartition(")")
    fields = after.split()
    threads, resident_bytes = max(1, int(fields[17])), int(fields[21]) * _PAGE_BYTES
    return ProcessEntry(
        pid, int(fields[1]), int(fields[2]), threads, resident_bytes, fields[0] in "ZX", before.partition("(")[2]
    )


def process_birth(pid: int) -> str | None:
    """Identifies a process beyond its pid: the boot and the kernel's count of time at its start.

    Setting the clock does not change it. None for a process that has ended.
    """
    try:
        fields = (_PROC / str(pid) / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return None if fields[0] in "ZX" else f"{boot_id()}:{fields[19]}"


def living(entries: Iterable[ProcessEntry]) -> list[ProcessEntry]:
    """The entries without zombies."""
    return [entry for entry in entries if not entry.zombie]


def all_processes() -> Iterable[ProcessEntry]:
    """Every process of the machine, zombies included."""
    for name in os.listdir(_PROC):  # noqa: PTH208 - a fork bomb makes thousands of them
        if name.isdigit() and (entry := read_process(int(name))) is not None:
            yield entry


def descendants(root: int) -> list[ProcessEntry]:
    """All processes below the process ``root``, zombies included."""
    children: dict[int, list[ProcessEntry]] = {}
    for entry in all_processes():
        children.setdefault(entry.parent, []).append(entry)
    found: list[ProcessEntry] = []
    waiting = list(children.get(root, []))
    while waiting:
        entry = waiting.pop()
        found.append(entry)
        waiting.extend(children.get(entry.pid, []))
    return found


def processes_of_user(uid: int) -> list[ProcessEntry]:
    """All processes of the user ``uid``, zombies included."""
    return [entry for entry in all_processes() if _owner(entry.pid) == uid]


def tasks_on_machine() -> int:
    """Processes and threads of the whole machine, from one small file."""
    return int((_PROC / "loadavg").read_text(encoding="ascii").split()[3].partition("/")[2])


def send(pids: Iterable[int], number: signal.Signals) -> None:
    """Send a signal to each process that still lives."""
    for pid in pids:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, number)


def send_to_group(group: int, number: signal.Signals) -> None:
    """Send a signal to all members of a process group at one moment."""
    if group <= 1:  # 0 is a group of another pid namespace; to signal group 1 means to signal everybody
        return
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(group, number)


def stop_and_kill(listed: Callable[[], list[ProcessEntry]]) -> None:
    """Stop everything that ``listed`` finds until it finds nothing new, then kill it all.

    What is stopped does not fork while the others are killed. A process group is signalled as a whole: the kernel does
    that at one moment, so that no member can fork in between.

    Args:
        listed: Lists the living processes as they are now.
    """
    known: dict[int, ProcessEntry] = {}
    deadline_s = monotonic_s() + _STOP_PATIENCE_S
    while monotonic_s() < deadline_s:
        fresh = [entry for entry in listed() if entry.pid not in known]
        if not fresh:
            break
        known.update({entry.pid: entry for entry in fresh})
        _signal_all(fresh, signal.SIGSTOP)
    _signal_all(known.values(), signal.SIGKILL)


def end_all(listed: Callable[[], list[ProcessEntry]], patience_s: float) -> bool:
    """:func:`stop_and_kill` until nothing is listed any more; whether that came true in time."""
    deadline_s = monotonic_s() + patience_s
    while listed():
        # Once in any case: on a slow machine with many processes, the list alone may take longer than the time.
        stop_and_kill(listed)
        if monotonic_s() >= deadline_s:
            return not listed()
        time.sleep(_PAUSE_S)
    return True


def _signal_all(entries: Iterable[ProcessEntry], number: signal.Signals) -> None:
    entries = list(entries)
    for group in {entry.group for entry in entries} - {os.getpgrp()}:
        send_to_group(group, number)
    send((entry.pid for entry in entries), number)


def _owner(pid: int) -> int | None:
    """The user; not the owner of the folder in ``/proc``, which is root for a process that asks not to be looked at."""
    try:
        status = (_PROC / str(pid) / "status").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return None
    return int(status.partition("\nUid:")[2].split(maxsplit=1)[0])
