"""Starts one algorithm, enforces its limits, and records how it ended: what ``shim`` does."""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import time
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import Any

from slamhive.base.clock import monotonic_s, utc_now
from slamhive.executors.cgroup import CGROUP_ROOT
from slamhive.executors.process import confinement
from slamhive.executors.process.confinement import (
    PR_SET_CHILD_SUBREAPER,
    PR_SET_NO_NEW_PRIVS,
    PR_SET_PDEATHSIG,
    confine_writes,
    limit_resources,
    prctl,
)
from slamhive.executors.process.containment import choose_containment
from slamhive.executors.process.containment_base import ProcessTree
from slamhive.executors.process.exit_file import CappedLog, LostOutput, reap, write_exit
from slamhive.executors.process.priority import raise_supervisor, urgent
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.process.table import end_all, process_birth, send, send_to_group
from slamhive.executors.refusals import RefusalWatch
from slamhive.executors.status import Protections

OUTPUT_FOLDER = "output"

_TICK_S = 0.05
_KILL_PATIENCE_S = 1.0
_READ_BYTES = 1 << 16
_EXIT_CANNOT_START = 127
_FILE_BYTES = 256 * 2**30
_SIGNALS = (signal.SIGTERM, signal.SIGUSR1)


class Supervisor:
    """Starts the algorithm, watches it and its descendants, and records how it ended.

    Args:
        work: The run's work folder.
        spec: The orders.
        own_scope: Whether systemd made a scope for this process.
        no_scope: Why it did not, though it was asked; empty if it was not.
    """

    def __init__(self, work: Path, spec: ShimSpec, *, own_scope: bool = False, no_scope: str = "") -> None:
        self._work = work
        self._spec = spec
        self._priority = raise_supervisor()
        request = replace(spec.containment_request(), own_scope=own_scope, no_scope=no_scope)
        chosen = choose_containment(request, spec.containment)
        self._containment = chosen.containment
        refused = confinement.refused_because()
        self._apart = refused is None
        self._does_not_hold = dict(chosen.does_not_hold)
        if refused is not None:
            self._does_not_hold["a network and a shared memory of its own"] = refused
        self._refusals = RefusalWatch(self._containment.patience_s)
        self._tree = ProcessTree(os.getpid())
        self._log = CappedLog(work / OUTPUT_FOLDER, spec.log_max_bytes)
        self._lost = LostOutput()
        self._status: int | None = None
        self._out_of_memory = False
        self._process_limit = False
        self._kill_asked = self._signalled = False
        self._checked_at_s = 0.0

    def introduction(self, started_at: datetime) -> dict[str, Any]:
        """The content of ``shim.json``: which process this is, and how it enforces limits."""
        protections = Protections(
            **self._containment.words(),
            priority=self._priority.words(shares_processors=not self._containment.holds_cpu),
            does_not_hold=self._does_not_hold,
        )
        return {
            "pid": os.getpid(),
            "birth": process_birth(os.getpid()),
            "started_at": started_at.isoformat(),
            "containment": self._containment.describe(),
            "protections": asdict(protections),
        }

    def run(self, started_at: datetime) -> None:
        """From start to ``exit.json``."""
        reader, writer = os.pipe()
        os.set_blocking(reader, False)
        self._pid = os.fork()
        if self._pid == 0:
            self._become_algorithm(writer)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        os.close(writer)
        while self._status is None:
            self._tick(reader)
        ended_at = utc_now()
        # The kernel's counters vanish with the run.
        look = self._containment.look(self._tree)
        self._out_of_memory |= look.out_of_memory
        self._refusals.see(refused=look.refused, now_s=monotonic_s())
        while True:  # the algorithm may have left processes
            self._kill_all()
            self._reap()
            if not self._containment.members() and not self._tree.living():
                break
        self._containment.remove()
        while self._copy_output(reader):
            pass
        self._log.close()
        exit_code = os.waitstatus_to_exitcode(self._status)
        content: dict[str, Any] = {
            "exit_code": 128 - exit_code if exit_code < 0 else exit_code,
            "out_of_memory": self._out_of_memory,
            "process_limit": self._process_limit,
            "refused_processes": self._refusals.refused,
            "signalled": self._signalled,
            "started_at": started_at.isoformat(),
            "ended_at": ended_at.isoformat(),
            "lost_output": self._lost.text,
        }
        write_exit(self._work, content)

    def _become_algorithm(self, writer: int) -> None:
        """In the child: set limits, enter the containment, become the command. Never returns."""
        try:
            for number in (*_SIGNALS, signal.SIGPIPE):
                signal.signal(number, signal.SIG_DFL)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
            os.setsid()  # kernels may share CPU time by session
            self._priority.give_back(shares_processors=not self._containment.holds_cpu)
            if cores := self._cores():
                os.sched_setaffinity(0, cores)
            if self._apart:
                confinement.enter_namespaces()
                for path in self._spec.read_only or ():
                    confinement.make_read_only(path)
            self._containment.enter()
            if self._apart:
                # Under version 2 the files of the group belong to the user, so the run could leave it.
                with contextlib.suppress(OSError):  # a user of its own may not mount, nor change any group
                    confinement.make_read_only(str(CGROUP_ROOT))
            # Only now: a change of user would undo it.
            prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
            # As in containers. This user could neither measure nor end a process of another user.
            prctl(PR_SET_NO_NEW_PRIVS, 1)
            limit_resources(self._spec.file_bytes or _FILE_BYTES)
            os.chdir(self._spec.folder)
            if self._spec.read_only is None:  # a confined process could not mount the files of a container
                confine_writes(self._spec.writable)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.dup2(writer, 1)
            os.dup2(writer, 2)
            os.execve(self._spec.command[0], self._spec.command, self._spec.environment)  # noqa: S606 - no shell wanted
        except OSError as error:
            os.write(writer, f"{self._spec.command[0]} cannot be started: {error}\n".encode())
        finally:
            os._exit(_EXIT_CANNOT_START)

    def _cores(self) -> list[int] | None:
        """The cores to bind to: the slot's, or enough for the limit if the kernel does not enforce it."""
        if self._spec.cores or self._spec.cpu_cores is None or self._containment.holds_cpu:
            return self._spec.cores
        return sorted(os.sched_getaffinity(0))[: math.ceil(self._spec.cpu_cores)]

    def listen(self) -> None:
        """Adopt descendants and handle signals. Called before the identity is published, since signals follow it.

        Signals wait until there is an algorithm to pass them on to. Its process must not handle them as this one does.
        """
        prctl(PR_SET_CHILD_SUBREAPER, 1)
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
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
        """Copy new output to the log; returns whether there was any."""
        try:
            data = os.read(reader, _READ_BYTES)
        except BlockingIOError:
            return False
        self._write_log(data)
        return bool(data)

    def _write_log(self, data: bytes) -> None:
        """Write to the log. If that fails, keep the end of the output and go on supervising."""
        try:
            self._log.write(data)
        except OSError as error:
            self._lost.add(data, error.strerror or str(error))

    def _reap(self) -> None:
        """Reap what has ended, and keep the exit status of the algorithm."""
        for pid, status in reap():
            if pid == self._pid:
                self._status = status

    def _check_limits(self) -> None:
        now_s = monotonic_s()
        if now_s - self._checked_at_s < _TICK_S:
            return
        self._checked_at_s = now_s
        look = self._containment.look(self._tree)
        limit_bytes = self._spec.memory_bytes
        if look.out_of_memory or (
            limit_bytes is not None and not self._containment.holds_memory and self._tree.resident_bytes() > limit_bytes
        ):
            self._out_of_memory = True
            self._kill_at("the memory limit" + ("" if limit_bytes is None else f" of {limit_bytes / 1e6:.0f} MB"))
        elif self._refusals.see(refused=look.refused, now_s=now_s):
            self._process_limit = True
            self._kill_at(f"the limit of {self._spec.tasks} processes and threads")

    def _kill_at(self, limit: str) -> None:
        self._write_log(f"[killed at {limit}]\n".encode())
        self._kill_asked = True
        self._kill_all()

    def _kill_all(self) -> None:
        """Kill the members of the containment, then what is left below the supervisor."""
        with urgent():
            if self._status is None:
                # Stops most of a fork bomb at once. After the algorithm is reaped, its pid may be another process.
                send_to_group(self._pid, signal.SIGSTOP)
            self._containment.end(_KILL_PATIENCE_S)
            end_all(self._tree.living, _KILL_PATIENCE_S)

    def _pass_on(self, _number: int, _frame: FrameType | None) -> None:
        self._signalled = True
        forwarders = self._spec.forwarders
        send((entry.pid for entry in self._tree.living() if entry.name not in forwarders), signal.SIGTERM)

    def _kill_on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._kill_asked = self._signalled = True
