"""The programs of a run: started in a group of their own, listened to, and ended without remains."""

from __future__ import annotations

import contextlib
import os
import re
import resource
import signal
import subprocess
import threading
from collections.abc import Callable, Mapping, Sequence

from slamhive.base.errors import SlamHiveError

_DIED = re.compile(r"\[([\w/-]+)\] process has died \[pid \d+, exit code (-?\d+)")
_COLOUR = re.compile(r"\x1b\[[0-9;]*m|\x1b\]2;[^\x07]*\x07")


class SystemFailed(SlamHiveError):
    """A program that the run needs ended, or did not start."""


class Program:
    """A running program and its output.

    Args:
        name: For messages.
        command: The command.
        take: Called with each line, by a thread.
        environment: Its environment variables.
    """

    def __init__(
        self, name: str, command: Sequence[str], take: Callable[[str], None], environment: Mapping[str, str]
    ) -> None:
        self.name = name
        self.last_line = ""
        self._take = take
        try:
            self._process = subprocess.Popen(
                command,
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                text=True,
                errors="replace",
            )
        except OSError as error:
            raise SystemFailed(f"{name} cannot be started: {error.strerror}") from None
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def exit_code(self) -> int | None:
        """None while it runs."""
        return self._process.poll()

    def check_running(self) -> None:
        """Raise SystemFailed with its last line if it has ended."""
        if self.exit_code is not None:
            self._reader.join(2.0)
            raise SystemFailed(f"{self.name} ended with exit code {self.exit_code}: {self.last_line or 'no output'}")

    def stop(self, patience_s: float) -> None:
        """Interrupt its whole group, and kill what is left after ``patience_s``."""
        for number in (signal.SIGINT, signal.SIGKILL):
            self._signal(number)
            try:
                self._process.wait(patience_s)
                break
            except subprocess.TimeoutExpired:
                continue
        self._signal(signal.SIGKILL)
        self._reader.join(2.0)

    def _signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)

    def _read(self) -> None:
        for raw in self._process.stdout or ():
            line = _COLOUR.sub("", raw).strip()
            if line:
                self.last_line = line
                self._take(line)


class NodeWatch:
    """Reads the output of ``roslaunch``: which node died, and which lines report a dropped frame.

    Args:
        drop_lines: Regular expressions of such lines.
        print_line: Called with every line.
    """

    def __init__(self, drop_lines: Sequence[str], print_line: Callable[[str], None]) -> None:
        self._drops = [re.compile(pattern) for pattern in drop_lines]
        self._print = print_line
        self.dropped = 0
        self.death: str | None = None

    def take(self, line: str) -> None:
        """Look at one line."""
        self._print(line)
        if any(pattern.search(line) for pattern in self._drops):
            self.dropped += 1
        died = _DIED.search(line)
        if died and self.death is None:
            self.death = f"the node {died[1]} died ({_in_words(int(died[2]))})"

    def check(self) -> None:
        """Raise SystemFailed if a node has died."""
        if self.death is not None:
            raise SystemFailed(self.death)


def children_cpu_s() -> float:
    """CPU time of all children that have ended and their children, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _in_words(exit_code: int) -> str:
    if exit_code < 0:
        return f"signal {signal.Signals(-exit_code).name}"
    return f"exit code {exit_code}"
