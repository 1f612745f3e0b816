"""Run a program that takes part in a build, and end it with all that it started when the build is given up."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import IO

QUIET_S = 2.0
"""After so long without a line, the last one comes again, so that whoever follows can give up."""
_GRACE_S = 5.0


def run_program(command: Sequence[str], variables: Mapping[str, str], on_line: Callable[[str], None]) -> int:
    """The exit code of a program, negative for a signal, whose lines went to ``on_line``.

    It has a session of its own: Ctrl-C in a terminal, which is for this process, does not make the build fail. If
    ``on_line`` raises, or this thread is interrupted, the program is ended with its children before that goes on.
    """
    with subprocess.Popen(
        command,
        env=dict(variables),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        try:
            last = "nothing said yet"
            for line in _lines(process.stdout):
                last = last if line is None else line
                on_line(last)
            process.wait()
        except BaseException:
            _end(process)
            raise
    return process.returncode


def _lines(stream: IO[bytes]) -> Iterator[str | None]:
    """The lines that are not blank as they come, and None after each time without any."""
    poll = select.poll()
    poll.register(stream, select.POLLIN)
    rest = b""
    while True:
        if not poll.poll(QUIET_S * 1000):
            yield None
            continue
        block = os.read(stream.fileno(), 65_536)
        *lines, rest = (rest + block).split(b"\n")
        if not block:
            lines, rest = [*lines, rest], b""
        yield from filter(None, (line.decode(errors="replace").strip() for line in lines))
        if not block:
            return


def _end(process: subprocess.Popen[bytes]) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):  # a script may have something to tidy up
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_GRACE_S)
