"""The supervisor of one algorithm process: ``python -m slamhive.executors.shim <work folder>``.

It outlives the worker that started it, so that a restarted worker finds out how the algorithm ended. Files in the work
folder are the whole interface: ``shim-spec.json`` in, ``shim.lock`` held while it lives, ``shim.json`` (who
am I, since when),
``output/`` (what the algorithm prints, capped), ``exit.json`` (how it ended; its room is taken beforehand, since an
algorithm may fill the disk).

Every descendant of the algorithm stays below the shim (it is their "subreaper"), so none can get away by forking twice
or by opening a session of its own, and the CPU time of each is added up when it is reaped.

Signals: SIGTERM is passed on to all descendants, SIGUSR1 kills them.
"""

from __future__ import annotations

import ctypes
import fcntl
import json
import os
import resource
import select
import signal
import sys
import time
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

import psutil

from slamhive.executors.capped_log import CappedLog
from slamhive.executors.exit_file import LostOutput, reserve, write_exit
from slamhive.executors.landlock import confine_writes
from slamhive.files import write_aside

SPEC_FILE = "shim-spec.json"
LOCK_FILE = "shim.lock"
IDENTITY_FILE = "shim.json"
OUTPUT_FOLDER = "output"

_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36
_PR_SET_NO_NEW_PRIVS = 38
_TICK_S = 0.05
_TREE_SCAN_S = 0.5
_READ_BYTES = 1 << 16
_EXIT_CANNOT_START = 127
_OPEN_FILES = 65_536
_FILE_BYTES = 256 * 2**30


@dataclass(frozen=True, slots=True)
class ShimSpec:
    """What to start: command, environment, folder to start in, and limits.

    ``tasks`` counts processes and threads, as a container's limit of pids does. ``file_bytes`` is the
    most that one file may have, ``writable`` are the folders that may be written to.
    """

    command: list[str]
    environment: dict[str, str]
    folder: str
    cores: list[int] | None
    memory_bytes: int | None
    tasks: int
    log_max_bytes: int
    file_bytes: int | None = None
    writable: list[str] = field(default_factory=list)

    def save(self, work: Path) -> None:
        """Write into the work folder."""
        write_aside(work / SPEC_FILE, json.dumps(asdict(self)))

    @classmethod
    def load(cls, work: Path) -> ShimSpec:
        """Read from the work folder."""
        return cls(**json.loads((work / SPEC_FILE).read_text(encoding="utf-8")))


class Supervisor:
    """Starts the algorithm, watches it and its descendants, and writes down how it ended."""

    def __init__(self, work: Path, spec: ShimSpec) -> None:
        self._work = work
        self._spec = spec
        self._log = CappedLog(work / OUTPUT_FOLDER, spec.log_max_bytes)
        self._lost = LostOutput()
        self._status: int | None = None
        self._out_of_memory = False
        self._kill_asked = False
        self._tree: list[psutil.Process] = []
        self._tree_at_s = 0.0
        self._checked_at_s = 0.0

    def run(self, started_at: datetime) -> None:
        """From start to ``exit.json``."""
        reserve(self._work)
        reader = self._spawn()
        while self._status is None:
            self._tick(reader)
        ended_at = datetime.now(UTC)
        self._end_descendants()
        while self._copy_output(reader):
            pass
        self._log.close()
        exit_code = os.waitstatus_to_exitcode(self._status)
        content: dict[str, Any] = {
            "exit_code": 128 - exit_code if exit_code < 0 else exit_code,
            "out_of_memory": self._out_of_memory,
            "started_at": started_at.isoformat(),
            "ended_at": ended_at.isoformat(),
            "lost_output": self._lost.text,
        }
        write_exit(self._work, content)

    def _spawn(self) -> int:
        """Fork the algorithm; returns the end of the pipe that its output comes out of."""
        reader, writer = os.pipe()
        os.set_blocking(reader, False)
        self._pid = os.fork()
        if self._pid == 0:
            self._become_algorithm(writer)
        os.close(writer)
        return reader

    def _become_algorithm(self, writer: int) -> None:
        """In the child: limits, a group of its own, then the command. Never returns."""
        try:
            os.setpgid(0, 0)
            _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
            # As containers: what becomes another user could neither be measured nor ended by this one.
            _prctl(_PR_SET_NO_NEW_PRIVS, 1)
            for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGPIPE):
                signal.signal(number, signal.SIG_DFL)
            _limit_resources(self._spec.file_bytes or _FILE_BYTES)
            if self._spec.cores:
                os.sched_setaffinity(0, self._spec.cores)
            os.chdir(self._spec.folder)
            confine_writes(self._spec.writable)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.dup2(writer, 1)
            os.dup2(writer, 2)
            os.execve(self._spec.command[0], self._spec.command, self._spec.environment)  # noqa: S606 - no shell wanted
        except OSError as error:
            os.write(writer, f"{self._spec.command[0]} cannot be started: {error}\n".encode())
        finally:
            os._exit(_EXIT_CANNOT_START)

    def listen(self) -> None:
        """Take on the descendants and the signals. Before anybody is told whom to send them to."""
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        signal.signal(signal.SIGTERM, self._pass_on)
        signal.signal(signal.SIGUSR1, self._kill_on_signal)

    def _tick(self, reader: int) -> None:
        ready, _, _ = select.select([reader], [], [], _TICK_S)
        if ready and not self._copy_output(reader):
            time.sleep(_TICK_S)
        self._reap()
        if self._kill_asked:
            self._kill_all()
        else:
            self._check_limits()

    def _copy_output(self, reader: int) -> bool:
        """Copy what has been printed to the log; False if there is nothing (more)."""
        try:
            data = os.read(reader, _READ_BYTES)
        except BlockingIOError:
            return False
        self._write_log(data)
        return bool(data)

    def _write_log(self, data: bytes) -> None:
        """A log that cannot be written is no reason to leave the algorithm without supervisor."""
        try:
            self._log.write(data)
        except OSError as error:
            self._lost.add(data, error.strerror or str(error))

    def _reap(self) -> None:
        """Wait for whatever has ended; the algorithm's own status is kept."""
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            if pid == self._pid:
                self._status = status

    def _check_limits(self) -> None:
        now_s = time.monotonic()
        if now_s - self._checked_at_s < _TICK_S:
            return
        self._checked_at_s = now_s
        if now_s - self._tree_at_s >= _TREE_SCAN_S:
            self._tree, self._tree_at_s = _descendants(), now_s
            if sum(_tasks(process) for process in self._tree) > self._spec.tasks:
                self._kill_at(f"the limit of {self._spec.tasks} processes and threads")
                return
        limit_bytes = self._spec.memory_bytes
        if limit_bytes is not None and sum(_resident_bytes(process) for process in self._tree) > limit_bytes:
            self._out_of_memory = True
            self._kill_at(f"the memory limit of {limit_bytes / 1e6:.0f} MB")

    def _kill_at(self, limit: str) -> None:
        self._write_log(f"[killed at {limit}]\n".encode())
        self._kill_asked = True
        self._kill_all()

    def _end_descendants(self) -> None:
        """Kill and reap what the algorithm left behind."""
        while _descendants():
            self._kill_all()
            self._reap()
            time.sleep(_TICK_S / 10)

    def _kill_all(self) -> None:
        """Stopped first: what is stopped does not fork while the others are killed."""
        _signal_all(_descendants(), signal.SIGSTOP)
        _signal_all(_descendants(), signal.SIGKILL)

    def _pass_on(self, _number: int, _frame: FrameType | None) -> None:
        _signal_all(_descendants(), signal.SIGTERM)

    def _kill_on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._kill_asked = True


def _descendants() -> list[psutil.Process]:
    return [process for process in psutil.Process().children(recursive=True) if _alive(process)]


def _alive(process: psutil.Process) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def _resident_bytes(process: psutil.Process) -> int:
    try:
        return int(process.memory_info().rss)
    except psutil.NoSuchProcess:
        return 0


def _tasks(process: psutil.Process) -> int:
    """The threads of a process, its first one included."""
    try:
        return process.num_threads()
    except psutil.NoSuchProcess:
        return 0


def _limit_resources(file_bytes: int) -> None:
    """Of the calling process and what it starts: no core dumps; files few and small enough to leave the machine usable.

    Not RLIMIT_NPROC: it counts all processes of the user, whose other runs are none of this one's business.
    """
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for kind, wanted in ((resource.RLIMIT_NOFILE, _OPEN_FILES), (resource.RLIMIT_FSIZE, file_bytes)):
        hard = resource.getrlimit(kind)[1]
        limit = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(kind, (limit, limit))


def _signal_all(processes: list[psutil.Process], number: signal.Signals) -> None:
    for process in processes:
        try:
            process.send_signal(number)
        except psutil.NoSuchProcess:
            continue


def _prctl(option: int, value: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(option, value, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl failed")


def process_birth(pid: int) -> str | None:
    """What tells a process from any other with its pid: this boot, and the clock tick it started at.

    Unlike a time of day it stays the same when the clock is set. None for a process that has ended.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return None if fields[0] in "ZX" else f"{boot}:{fields[19]}"


def main(work: Path) -> None:
    """Supervise the run of this work folder, unless another shim does or did.

    The process that was started ends at once and leaves the work to a child in a session of its own, which therefore
    belongs to nobody: neither the end of the worker nor that of its terminal reaches it.
    """
    if os.fork() > 0:
        os._exit(0)
    os.setsid()
    descriptor = os.open(work / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return
    if (work / IDENTITY_FILE).exists():
        return
    supervisor = Supervisor(work, ShimSpec.load(work))
    supervisor.listen()
    started_at = datetime.now(UTC)
    identity = {"pid": os.getpid(), "birth": process_birth(os.getpid()), "started_at": started_at.isoformat()}
    write_aside(work / IDENTITY_FILE, json.dumps(identity))
    supervisor.run(started_at)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
