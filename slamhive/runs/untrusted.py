"""Reads what an algorithm left, without trusting it: no links, no pipes, nothing huge, no odd numbers."""

from __future__ import annotations

import io
import logging
import math
import os
import stat
from array import array
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from slamhive.errors import InvalidInput
from slamhive.input_bounds import parse_json_object

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
    lines = sum(data.count(end.encode()) for end in _LINE_ENDS)
    if lines > MOST_LINES:
        return f"has {lines} lines, more than the {MOST_LINES} that are read"
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

    What is returned follows the rule of :mod:`slamhive.input_bounds`, and so can be written again as strict JSON.
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
    values = array("d")
    for row in _rows(lines, [header.index(name) for name in columns]):
        values.extend(row)
    return np.array(values).reshape(-1, len(columns))


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
