"""Times that a node wrote by its own clock, by the clock of the worker: time limits compare them with it.

The shared file system notes when a file was written, by one clock for all. Its difference from the clock of the worker
is measured with a file that the worker writes itself.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

from slamhive.base.clock import utc_now
from slamhive.base.files import write_aside
from slamhive.executors.process.executor import read_json

START_FILE = "started-at.json"
_PROBE_FILE = "clock-probe"
_LEAST = timedelta(seconds=10)
"""Seconds may lie between a time and its writing: on a slow file system, or while processes are ended."""


def by_this_clock(file: Path, said: datetime) -> datetime:
    """The time at which ``file`` was written, if it is too far from the time ``said`` in it for equal clocks."""
    probe = file.with_name(_PROBE_FILE)
    try:
        probe.write_bytes(b"x")
        written = _written(file) - (_written(probe) - utc_now())
    except OSError:  # the disk is full: a time that may be wrong is better than no end of the run
        return said
    return said if abs(written - said) < _LEAST else written


def start_by_this_clock(file: Path, said: datetime) -> datetime:
    """The same for the start of a run. The answer is kept, because every look must give the same."""
    kept = read_json(file.with_name(START_FILE))
    if kept is not None:
        return datetime.fromisoformat(kept["started_at"])
    found = by_this_clock(file, said)
    if found != said:
        write_aside(file.with_name(START_FILE), json.dumps({"started_at": found.isoformat()}))
    return found


def difference_in_words(node: str, said: datetime, found: datetime) -> str | None:
    """The difference of the node's clock; None if ``said`` was taken as it is."""
    if said == found:
        return None
    ahead_s = (said - found).total_seconds()
    words = f"{abs(ahead_s):.0f} s {'ahead' if ahead_s > 0 else 'behind'}"
    return f"the clock of node {node} is {words}; times of the run are corrected"


def _written(file: Path) -> datetime:
    return datetime.fromtimestamp(file.stat().st_mtime, UTC)
