"""The supervisors of runs, seen from the worker: started, found again, and cleaned up after."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import psutil

import slamhive
from slamhive.clock import monotonic_s
from slamhive.errors import Unavailable
from slamhive.executors.base import StartFailed
from slamhive.executors.process.containment import found_again
from slamhive.executors.process.containment_base import Containment
from slamhive.executors.process.exit_file import EXIT_FILE
from slamhive.executors.process.paths import INHERITED, KEY_VARIABLE
from slamhive.executors.process.scope import NO_SCOPE, run_in_scope
from slamhive.executors.process.shim import IDENTITY_FILE, NO_ROOM
from slamhive.executors.process.table import ProcessEntry, all_processes, end_all, living, process_birth
from slamhive.executors.status import Exited, RunHandle

START_WAIT_S = 15.0
KILL_WAIT_S = 5.0
_ASKED_FILE = "asked-to-end"
_STEP_S = 0.02
_ERRORS_BYTES = 4096


def containment_of(handle: RunHandle) -> Containment | None:
    """The containment of the run, if others than its supervisor can use it."""
    return found_again(json.loads(handle.data.get("containment", "{}")))


def launch(work: Path, *, in_scope: bool = False) -> dict[str, Any]:
    """Start a supervisor for ``work``, and wait until it or an earlier one has written its identity.

    Raises StartFailed; Unavailable or OSError if the disk is full, which is not the run's fault.

    Args:
        work: The run's work folder, with the orders.
        in_scope: Ask systemd for a scope for it. If that fails, the supervisor starts without, and records why.
    """
    errors = work / "shim-errors.txt"
    with errors.open("wb") as stream:
        stream.write(b" " * _ERRORS_BYTES)  # so that a full disk does not hide the reason
    package_root = str(Path(slamhive.__file__).parent.parent)
    environment = {key: os.environ[key] for key in INHERITED if key in os.environ} | {"PYTHONPATH": package_root}
    command = [sys.executable, "-m", "slamhive.executors.process.shim", str(work)]
    with errors.open("r+b") as stream:
        refused = run_in_scope(command, environment, stream.fileno()) if in_scope else ""
        if refused is not None:
            # If the first one has started all the same, it holds the lock, and this one ends at once.
            arguments = [NO_SCOPE, refused] if refused else []
            subprocess.run(
                [*command, *arguments],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                cwd="/",
                check=False,
            )
    if not wait_until(lambda: (work / IDENTITY_FILE).exists() or _said(errors).startswith(NO_ROOM), START_WAIT_S):
        raise StartFailed(f"the supervisor process did not start: {_said(errors) or 'it says nothing'}")
    if not (work / IDENTITY_FILE).exists():
        raise Unavailable(f"the supervisor process did not start: {_said(errors)}", "make room on the disk")
    identity = read_json(work / IDENTITY_FILE)
    assert identity is not None
    return identity


def _said(errors: Path) -> str:
    """The last line that a supervisor has written."""
    lines = errors.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else ""


def read_json(path: Path) -> dict[str, Any] | None:
    """A file that a supervisor writes in one step; None if it is not there yet."""
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    return content


class RecordedEnd(NamedTuple):
    """The end of a run, and whether somebody other than a worker asked for it: the exit code says nothing then."""

    exited: Exited
    from_outside: bool


def read_end(handle: RunHandle) -> RecordedEnd | None:
    """Read how the run ended; None if it has not, or if nobody recorded it."""
    work = Path(handle.data["work"])
    content = read_json(work / EXIT_FILE)
    if content is None:
        return None
    exited = Exited(
        exit_code=content["exit_code"],
        out_of_memory=content["out_of_memory"],
        process_limit=content.get("process_limit", False),
        refused_processes=content.get("refused_processes", False),
        started_at=datetime.fromisoformat(content["started_at"]),
        ended_at=datetime.fromisoformat(content["ended_at"]),
    )
    return RecordedEnd(exited, bool(content.get("signalled")) and not (work / _ASKED_FILE).exists())


def note_asked(handle: RunHandle) -> None:
    """Note that a worker ends the run, before it does so."""
    with contextlib.suppress(OSError):  # a disk that is full must not keep a run alive
        (Path(handle.data["work"]) / _ASKED_FILE).touch()


def supervisor_of(handle: RunHandle) -> psutil.Process | None:
    """The supervisor if it is alive; a process with its pid may be another one, so the start time counts too."""
    pid = int(handle.data["pid"])
    if process_birth(pid) != handle.data["birth"]:
        return None
    try:
        return psutil.Process(pid)
    except psutil.NoSuchProcess:
        return None


def kill_leftovers(handle: RunHandle) -> None:
    """Kill what a killed supervisor leaves: the members of its containment, and processes with the run's key."""
    supervisor = supervisor_of(handle)
    if supervisor is not None:
        send_signal(supervisor, signal.SIGKILL)
        # Until it has ended it holds the lock on the run's user, and nobody else can tell who belongs to the run.
        wait_until(lambda: supervisor_of(handle) is None, KILL_WAIT_S)
    containment = containment_of(handle)
    if containment is not None:
        containment.end(KILL_WAIT_S)
        containment.remove()
    end_all(lambda: _with_key(handle.data["key"]), KILL_WAIT_S)


def _with_key(key: str) -> list[ProcessEntry]:
    """The living processes that carry the run's key in their environment."""
    mark = f"{KEY_VARIABLE}={key}".encode()
    return [entry for entry in living(all_processes()) if mark in _environment(entry.pid)]


def _environment(pid: int) -> list[bytes]:
    try:
        return Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return []


def send_signal(process: psutil.Process, number: signal.Signals) -> None:
    """Send a signal, unless the process has ended."""
    try:
        process.send_signal(number)
    except psutil.NoSuchProcess:
        return


def wait_until(condition: Callable[[], bool], patience_s: float) -> bool:
    """Wait for ``condition``; returns whether it came true within ``patience_s``."""
    deadline_s = monotonic_s() + patience_s
    while not condition():
        if monotonic_s() >= deadline_s:
            return False
        time.sleep(_STEP_S)
    return True
