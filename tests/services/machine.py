"""A machine that dies at a moment: workers, what they have started and the database are killed at once."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from slamhive.executors.process import shim
from slamhive.services.worker import WorkerLock
from tests.services.mariadb import DatabaseServer
from tests.waiting import PATIENCE_S, eventually

NURSERY = Path(__file__).with_name("worker_nursery.py")
CHECKOUT = NURSERY.parents[2]
MOST_ROUNDS = 50
SUPERVISOR = shim.__name__
"""What the command lines of supervisors of runs have in common."""


@dataclass(frozen=True)
class Killed:
    """The number of processes that died with the machine, and of containers and supervisors of runs among them."""

    processes: int
    executing: int


class Machine:
    """Workers of one data root, and whatever they start.

    Args:
        data: The data root; every process that belongs to the machine names it in its command or its environment.
        log: What the workers print.
        database: Dies with the machine, None for one that is no process.
        containers: The pids of the main processes of containers.
    """

    def __init__(
        self,
        data: Path,
        log: Path,
        database: DatabaseServer | None = None,
        containers: Callable[[], list[int]] = list,
    ) -> None:
        self.data = data
        self.log = log
        self.database = database
        self._containers = containers
        self._workers: list[int] = []
        self._nursery: subprocess.Popen[str] | None = None

    def start_worker(self, **options: Any) -> int:
        """Start a worker; its pid. ``options``: settings, ``until_idle``, and ``host``, the name of its machine."""
        if self._nursery is None:
            self._nursery = subprocess.Popen(
                [sys.executable, str(NURSERY), str(self.log)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=CHECKOUT, env={**os.environ},
            )  # fmt: skip
        assert self._nursery.stdin is not None
        assert self._nursery.stdout is not None
        self._nursery.stdin.write(json.dumps(options) + "\n")
        self._nursery.stdin.flush()
        pid = int(self._nursery.stdout.readline())
        self._workers.append(pid)
        return pid

    def works(self) -> bool:
        """Whether a worker lives."""
        return any(psutil.pid_exists(pid) for pid in self._workers)

    def die(self) -> Killed:
        """Kill everything at once. All are stopped before the first is killed, so that none sees another die."""
        known: set[int] = set()
        if self.database is not None:
            self.database.freeze(frozen=True)
        for _ in range(MOST_ROUNDS):
            new = set(self._own()) - known
            for pid in new:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGSTOP)
            known |= new
            if not new:
                break
        executing = len(self._containers()) + sum(SUPERVISOR in line for line in self.processes())
        if self.database is not None:
            self.database.kill()
        self._end(known)
        self._workers.clear()
        eventually(self._is_dead, "the end of all processes")
        return Killed(len(known), executing)

    def _is_dead(self) -> bool:
        """Whether nothing is left. A process that was just becoming another program had no name that could be found."""
        left = set(self._own())
        self._end(left)
        return not left and not WorkerLock(self.data).held_elsewhere()

    @staticmethod
    def _end(pids: Iterable[int]) -> None:
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def kill_worker(self, pid: int) -> None:
        """Kill one worker; what it has started goes on."""
        os.kill(pid, signal.SIGKILL)
        self._workers.remove(pid)
        eventually(lambda: not psutil.pid_exists(pid), "the end of the worker")

    def boot(self) -> None:
        """Bring the database up again."""
        if self.database is not None:
            self.database.start()

    def work_to_the_end(self, patience_s: float = 4 * PATIENCE_S, **options: Any) -> None:
        """Have a worker work until nothing is left to do."""
        pid = self.start_worker(until_idle=True, **options)
        eventually(lambda: not psutil.pid_exists(pid), f"the end of all work (see {self.log})", patience_s)

    def processes(self) -> list[str]:
        """The command lines of all that lives."""
        found = []
        for pid in self._own():
            with suppress(psutil.Error):
                found.append(" ".join(psutil.Process(pid).cmdline()))
        return found

    def close(self) -> None:
        """End everything."""
        self.die()
        if self._nursery is None:
            return
        self._nursery.kill()
        self._nursery.wait()
        for stream in (self._nursery.stdin, self._nursery.stdout):
            if stream is not None:
                stream.close()

    def _own(self) -> Iterator[int]:
        spared = {os.getpid(), os.getppid(), self._nursery and self._nursery.pid, self.database and self.database.pid}
        name = str(self.data)
        for process in psutil.process_iter():
            if process.pid in spared:
                continue
            with suppress(psutil.Error):
                if process.status() == psutil.STATUS_ZOMBIE:
                    continue
                named = any(name in text for text in (*process.cmdline(), *process.environ().values()))
                if named or process.pid in self._workers:
                    yield process.pid
        yield from self._containers()


def wait_s(seconds: float) -> None:
    """Let the machine work for a while: the moment at which it dies is the point of the test."""
    time.sleep(seconds)
