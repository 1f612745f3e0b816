"""Scripts that start processes without end, up to bounds of their own if nobody stops them: 2,000 processes and 20 s.

A byte is appended to one file before each fork and to another after each that was refused; their lengths say whether
the fork may be made. Nobody can pass the bound by being quick.
"""

from __future__ import annotations

from pathlib import Path

MOST_PROCESSES = 2000
MOST_S = 20

_HEAD = f"""
import os, pathlib, signal, sys, time
result = pathlib.Path(os.environ.get('SLAMHIVE_RESULT', '/slamhive/result'))
flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
asked, refused = os.open(result / 'forks', flags, 0o666), os.open(result / 'refused', flags, 0o666)
end_s = time.monotonic() + {MOST_S}
signal.alarm({MOST_S})

def fork():
    os.write(asked, b'.')
    if os.fstat(asked).st_size - os.fstat(refused).st_size > {MOST_PROCESSES} or time.monotonic() > end_s:
        time.sleep(max(0, end_s - time.monotonic()))
        os._exit(0)
    try:
        pid = os.fork()
    except OSError:
        os.write(refused, b'.')
        time.sleep(0.01)
        return None
    signal.alarm(max(1, int(end_s - time.monotonic())))
    return pid
"""

FORKS = (
    _HEAD
    + """
while True:
    fork()
"""
)
"""Every process forks for ever, and tries again when it is refused."""

SESSIONS = (
    _HEAD
    + """
while True:
    if fork() == 0:
        os.setsid()
        if fork() != 0:
            os._exit(0)
"""
)
"""Each is in a session of its own and has lost its parent: no process group and no line of descent holds them."""

SHORT_LIVED = (
    _HEAD
    + """
while True:
    if fork() == 0:
        time.sleep(0.2)
        if fork() != 0:
            os._exit(0)
"""
)
"""They end soon and are replaced by others."""


def started_by(result: Path) -> int:
    """How many processes a bomb has started."""
    return (result / "forks").stat().st_size - (result / "refused").stat().st_size


BOMBS = {"forks": FORKS, "sessions": SESSIONS, "short lived": SHORT_LIVED}
