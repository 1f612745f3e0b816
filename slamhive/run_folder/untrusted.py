"""Reads what an algorithm left, without trusting it: no links, no pipes, nothing huge, no odd numbers."""

from __future__ import annotations

import io
import logging
import math
import os
import re
import stat
import tempfile
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from slamhive.base.bounds import parse_json_object
from slamhive.base.errors import InvalidInput
from slamhive.base.tree import DEEPEST_FOLDERS, walk
from slamhive.run_folder.folder import RunFolder

FloatArray = npt.NDArray[np.float64]

logger = logging.getLogger(__name__)

LARGEST_NUMBER = 1e100
"""Nothing that is measured is larger; differences and squares of what is smaller are still finite."""
MOST_LINES = 2_500_000
"""Of a table: 23 hours at 30 Hz. A line costs a hundred bytes of memory even if it holds one character."""
LONGEST_LINE_BYTES = 1_000_000
_LINE_ENDS = ("\n", "\r", "\v", "\f", "\x1c", "\x1d", "\x1e", "\x85", "\u2028", "\u2029")


def open_regular_file(path: Path) -> BinaryIO | None:
    """The regular file at ``path``, opened without waiting; None if there is none, as for a link, pipe or folder.

    The parent folder is followed, the file itself is not: an algorithm may have put a link to anything in its place.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        return None
    return os.fdopen(descriptor, "rb")


def read_regular_file(path: Path, limit_bytes: int) -> bytes | None:
    """The first ``limit_bytes`` of what :func:`open_regular_file` opens; None if there is none."""
    stream = open_regular_file(path)
    if stream is None:
        return None
    with stream:
        return stream.read(limit_bytes)


def too_much_because(data: bytes) -> str | None:
    """In words, why lines of ``data`` would take far more memory than its size; None if they would not."""
    # Each line has an end of at least one byte, so few bytes are no reason to count.
    lines = sum(data.count(end.encode()) for end in _LINE_ENDS) if len(data) > MOST_LINES else 0
    if lines > MOST_LINES:
        return f"has {lines} lines, more than the {MOST_LINES} that are read"
    if len(data) <= LONGEST_LINE_BYTES:
        return None
    ends = np.flatnonzero(np.frombuffer(data, dtype=np.uint8) == ord("\n"))
    if np.diff(ends, prepend=-1, append=len(data)).max() > LONGEST_LINE_BYTES + 1:
        return f"has a line of more than {LONGEST_LINE_BYTES} bytes"
    return None


def read_untrusted_lines(path: Path, limit_bytes: int) -> bytes | None:
    """The text file at ``path``, whole; None if there is none, or if it is too much to be read as lines."""
    data = read_regular_file(path, limit_bytes + 1)
    if data is None:
        return None
    problem = f"has more than {limit_bytes} bytes" if len(data) > limit_bytes else too_much_because(data)
    if problem is not None:
        logger.warning("%s is not read: it %s", path, problem)
        return None
    return data


def read_untrusted_json(path: Path, limit_bytes: int) -> dict[str, Any] | None:
    """The JSON object in the file at ``path``, None if there is no usable one.

    What is returned follows the rule of :mod:`slamhive.base.bounds`, and so can be written again as strict JSON.
    """
    data = read_regular_file(path, limit_bytes + 1)
    return None if data is None or len(data) > limit_bytes else parse_untrusted_json(data)


def parse_untrusted_json(data: bytes) -> dict[str, Any] | None:
    """The JSON object that ``data`` is, under the same conditions as :func:`read_untrusted_json`."""
    try:
        return parse_json_object(data, "the file", recorded=True)
    except InvalidInput:
        return None


def measured_number(value: object) -> float | None:
    """``value`` if it is a number that something measured could have: finite and not negative; else None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if 0 <= value <= LARGEST_NUMBER else None


def read_numeric_columns(path: Path, columns: Sequence[str], limit_bytes: int) -> FloatArray:
    """The named columns of the CSV file at ``path``, whose first line names them; shape (n, len(columns)).

    An empty field, NaN, and a number beyond :data:`LARGEST_NUMBER` are NaN. Lines that are no numbers are skipped;
    without the file, or without one of the columns, there are no rows. Nor are there of a file that is longer than
    ``limit_bytes``: its beginning is not what it says.
    """
    data = read_untrusted_lines(path, limit_bytes) or b""
    lines = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8", errors="replace")
    header = [name.strip() for name in lines.readline().split(",")]
    if not set(columns) <= set(header):
        return np.empty((0, len(columns)))
    fast = _plain_table(data, len(header), [header.index(name) for name in columns])
    if fast is not None:
        return fast
    values = array("d")
    for row in _rows(lines, [header.index(name) for name in columns]):
        values.extend(row)
    return np.array(values).reshape(-1, len(columns))


_PLAIN = re.compile(rb"[0-9.,eE+\-\n]*")


def _plain_table(data: bytes, width: int, places: Sequence[int]) -> FloatArray | None:
    """The columns at ``places`` of a table of plain numbers below its heading; None if it has anything else."""
    begin = data.find(b"\n") + 1
    if (
        begin == 0
        or begin == len(data)
        or not _PLAIN.fullmatch(data, begin)
        or b"\n\n" in data
        or b"\r" in data[:begin]
    ):
        return None
    try:
        rows = np.loadtxt(io.BytesIO(data[begin:]), delimiter=",", ndmin=2, dtype=np.float64)
    except ValueError:
        return None
    if rows.shape[1] != width:
        return None
    found: FloatArray = rows[:, places]
    return np.where(np.abs(found) <= LARGEST_NUMBER, found, np.nan)


def _rows(lines: Iterable[str], places: list[int]) -> Iterator[list[float]]:
    for line in lines:
        fields = line.split(",")
        try:
            yield [_field(fields[place]) for place in places]
        except (ValueError, IndexError):
            continue


def _field(text: str) -> float:
    value = float(text) if text.strip() else math.nan
    return value if abs(value) <= LARGEST_NUMBER else math.nan


# Measures what a run left in its folders, and removes what is no plain file.


_KINDS = (
    (stat.S_ISLNK, "links"),
    (stat.S_ISFIFO, "pipes"),
    (stat.S_ISSOCK, "sockets"),
    (stat.S_ISBLK, "devices"),
    (stat.S_ISCHR, "devices"),
)
_BLOCK_BYTES = 512
_RUNS_AS_OWNER = stat.S_ISUID | stat.S_ISGID


@dataclass(frozen=True, slots=True)
class DiskLimits:
    """The most that a run may write in its folders; None means no limit of ours."""

    size_bytes: int | None = None
    files: int | None = None


@dataclass
class Survey:
    """The content of the folders that a run writes to.

    Attributes:
        files: How many files, folders and whatever else.
        size_bytes: Their sizes; of a file with holes that of a copy without, since archives and downloads make one.
        strange: How many of each kind must not stay in the result, see :func:`strange_kind`.
        exceeded: In words the limit that is exceeded, None if none is; nothing was looked at behind that.
    """

    files: int = 0
    size_bytes: int = 0
    strange: Counter[str] = field(default_factory=Counter)
    exceeded: str | None = None


def survey(folder: RunFolder, limits: DiskLimits) -> Survey:
    """Measure the result and the scratch space of a run, up to ``limits``. Opens nothing but folders."""
    found = Survey()
    owner = _owner(folder.result)
    for part in (folder.result, folder.work):
        for entry in walk(part):
            found.files += 1
            found.size_bytes += _size_bytes(entry.status)
            kind = strange_kind(entry.status, owner)
            if kind is not None and part == folder.result:
                found.strange[kind] += 1
            if entry.is_folder and not entry.entered:
                found.exceeded = f"a folder that is closed, or inside more than {DEEPEST_FOLDERS} others"
            elif limits.size_bytes is not None and found.size_bytes > limits.size_bytes:
                found.exceeded = f"more than {limits.size_bytes / 1e6:.0f} MB, files with holes counted whole"
            elif limits.files is not None and found.files > limits.files:
                found.exceeded = f"more than {limits.files} files and folders"
            if found.exceeded is not None:
                return found
    return found


def strange_kind(status: os.stat_result, owner: int | None) -> str | None:
    """The kind of a file that must not stay in a result; None for a plain file or folder.

    Links lead elsewhere, now or after the folder is copied. Whoever opens a pipe or a device may wait for ever. A hard
    link, or a file of another user, belongs to somebody else. A file that runs as its owner would run as the worker.
    """
    kind = next((words for test, words in _KINDS if test(status.st_mode)), None)
    if kind is not None:
        return kind
    if owner is not None and status.st_uid != owner:
        return "files of another user"
    if stat.S_ISREG(status.st_mode):
        if status.st_nlink > 1:
            return "hard links"
        if status.st_mode & _RUNS_AS_OWNER:
            return "files that run as their owner"
    return None


def settle(folder: RunFolder, found: Survey, limits: DiskLimits) -> list[str]:
    """Remove what must not stay in the result of a run that has ended; returns in words what could not be removed.

    If the run exceeded a limit, only the files of the contract stay, as far as they fit. The rest moves into its
    scratch space, which takes no time whatever its size. Raises OSError.
    """
    if found.exceeded is not None:
        # A new folder takes the place of the old one. It can be done again if it was cut off.
        fresh = folder.work / "kept"
        fresh.mkdir(parents=True, exist_ok=True)
        for name in _kept(folder, limits):
            (folder.result / name).rename(fresh / name)
        if folder.result.exists():
            folder.result.rename(Path(tempfile.mkdtemp(dir=folder.work)) / folder.result.name)
        fresh.rename(folder.result)
    problems: list[str] = []
    owner = _owner(folder.result)
    for entry in walk(folder.result):
        if not entry.is_folder and strange_kind(entry.status, owner) is not None:
            try:
                os.unlink(entry.name, dir_fd=entry.folder)
            except OSError as error:
                problems.append(f"{entry.place!r}: {error.strerror}")
    return problems


def removed_in_words(removed: Mapping[str, int]) -> str:
    """``removed from its result: links (2), pipes (1)``; empty if nothing was."""
    parts = ", ".join(f"{kind} ({number})" for kind, number in sorted(removed.items()))
    return f"removed from its result: {parts}" if parts else ""


def _kept(folder: RunFolder, limits: DiskLimits) -> set[str]:
    """The names of the contract's files that fit into the limit together, the most wanted first."""
    room_bytes = math.inf if limits.size_bytes is None else limits.size_bytes
    kept = set()
    for path in folder.contract_files:
        try:
            status = path.lstat()
        except OSError:
            continue
        size_bytes = _size_bytes(status)
        if stat.S_ISREG(status.st_mode) and size_bytes <= room_bytes:
            kept.add(path.name)
            room_bytes -= size_bytes
    return kept


def _size_bytes(status: os.stat_result) -> int:
    """The larger of what a copy takes and what the file takes here: it may have holes, or blocks that are not used."""
    return max(status.st_size, status.st_blocks * _BLOCK_BYTES)


def _owner(folder: Path) -> int | None:
    """Whose folder it is; None if there is none."""
    try:
        return folder.lstat().st_uid
    except OSError:
        return None
