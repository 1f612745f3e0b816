"""The line of a run's output that says why it failed. The output is the algorithm's and not trusted."""

from __future__ import annotations

import os
from pathlib import Path

from slamhive.runs.untrusted import open_regular_file

ERROR_PREFIX = "error: "
TAIL_BYTES = 20_000
MAX_CHARACTERS = 300


def last_error_line(log: str) -> str | None:
    """The text after the last ``error: `` at the head of a line, on one line of printable text; None without one.

    At most :data:`MAX_CHARACTERS` characters are kept.
    """
    for line in reversed(log.splitlines()):
        if line.lower().startswith(ERROR_PREFIX):
            text = printable(line[len(ERROR_PREFIX) :])
            if text:
                return text
    return None


def printable(text: str) -> str:
    """``text`` on one line of at most :data:`MAX_CHARACTERS` printable characters."""
    line = " ".join("".join(character if character.isprintable() else " " for character in text).split())
    return line if len(line) <= MAX_CHARACTERS else f"{line[: MAX_CHARACTERS - 1]}…"


def read_tail(path: Path, max_bytes: int = TAIL_BYTES) -> str:
    """The end of the regular file at ``path``; empty if there is none, as for a link, pipe or folder."""
    stream = open_regular_file(path)
    if stream is None:
        return ""
    with stream:
        stream.seek(max(0, os.fstat(stream.fileno()).st_size - max_bytes))
        return stream.read(max_bytes).decode("utf-8", errors="replace")
