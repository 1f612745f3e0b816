"""Reads tables of numbers from text files; errors name the line."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from slamhive.errors import InvalidInput, NotFound
from slamhive.trajectory.model import FloatArray

IntArray = npt.NDArray[np.int64]

MAX_FILE_BYTES = 200_000_000
"""Longer files are refused: at 100 bytes a pose this is two million poses."""

_SHOWN_CHARACTERS = 40


@dataclass(frozen=True, slots=True)
class NumberTable:
    """The numbers of a text file, and their lines.

    Attributes:
        name: The file, as messages shall call it.
        values: Shape (rows, columns).
    """

    name: str
    values: FloatArray
    _lines: list[str]

    def line_number(self, row: int) -> int:
        """The line of row ``row`` in the file, from 1."""
        holding = (number for number, line in enumerate(self._lines, start=1) if _is_row(line))
        return next(number for index, number in enumerate(holding) if index == row)

    @property
    def places(self) -> IntArray:
        """The place of each row in a list whose lines belong to frames, from 0, shape (rows,).

        A blank line between rows stands for a frame of which nothing is known. Comments, and blank lines next to
        those above the first row, are no places.
        """
        found: list[int] = []
        place = 0
        for line in self._lines:
            if _is_row(line):
                found.append(place)
            elif line.strip():
                place = place if found else 0
                continue
            place += 1
        return np.array(found, dtype=np.int64)

    def take(self, rows: IntArray) -> NumberTable:
        """The table without its other rows; line numbers stay those of the file."""
        kept = set(rows.tolist())
        holding = iter(range(len(self.values)))
        lines = [line if not _is_row(line) or next(holding) in kept else "" for line in self._lines]
        return NumberTable(self.name, self.values[rows], lines)

    def error(self, row: int, found: str, remedy: str) -> InvalidInput:
        """An error about row ``row``."""
        return InvalidInput(f"{self.name}, line {self.line_number(row)}: {found}", remedy)


def read_bounded(path: Path) -> bytes:
    """The bytes of the regular file at ``path``.

    Raises:
        NotFound: There is no such file.
        InvalidInput: It is a folder or a pipe, cannot be read, or has more than :data:`MAX_FILE_BYTES`.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise NotFound(f"{path} does not exist") from None
    except OSError as error:
        raise InvalidInput(f"{path} cannot be read: {error.strerror}") from None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise InvalidInput(f"{path} is not a regular file")
    with os.fdopen(descriptor, "rb") as stream:
        data = stream.read(MAX_FILE_BYTES + 1)
    if len(data) > MAX_FILE_BYTES:
        raise InvalidInput(f"{path} has more than {MAX_FILE_BYTES / 1e6:.0f} MB", "split it, or write less")
    return data


def count_columns(data: bytes) -> int:
    """The number of columns of the first row; 0 without rows."""
    rows = (line for line in data.splitlines() if line.strip() and not line.lstrip().startswith(b"#"))
    return len(next(rows, b"").replace(b",", b" ").split())


def parse_table(data: bytes, name: str, columns: int, layout: str, *, more_columns: bool = False) -> NumberTable:
    """Read rows of ``columns`` numbers separated by blanks or commas; ``#`` starts a comment line.

    Args:
        data: The bytes of the file.
        name: What messages call it.
        columns: How many numbers a row holds.
        layout: The columns in words, for messages.
        more_columns: Rows may hold more, which are left out.

    Raises:
        InvalidInput: Not text, no row at all, or a bad row, named by its line.
    """
    lines = _text(data, name, layout).splitlines()
    rows = [line for line in lines if _is_row(line)]
    if not rows:
        raise InvalidInput(f"{name} is empty: it holds no line of numbers", f"expected lines of {layout}")
    if any("," in row for row in rows):
        rows = [row.replace(",", " ") for row in rows]
    try:
        values = np.loadtxt(rows, dtype=np.float64, comments=None, ndmin=2)
    except ValueError:
        values = np.empty((0, 0))
    if values.shape[1] == columns:
        return NumberTable(name, values, lines)
    if more_columns and values.shape[1] > columns:
        return NumberTable(name, values[:, :columns], lines)
    if more_columns:
        columns = max(columns, len(rows[0].split()))
    raise _first_bad_row(NumberTable(name, values, lines), rows, columns, layout)


def _text(data: bytes, name: str, layout: str) -> str:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        found = f"byte 0x{data[error.start]:02x} at position {error.start}"
        raise InvalidInput(f"{name} is not a text file: {found}", f"expected lines of {layout}") from None
    position = text.find("\0")
    if position >= 0:
        raise InvalidInput(
            f"{name} is not a text file: byte 0x00 at position {position}", f"expected lines of {layout}"
        )
    return text


def _is_row(line: str) -> bool:
    content = line.lstrip()
    return content != "" and content[0] != "#"


def _first_bad_row(table: NumberTable, rows: list[str], columns: int, layout: str) -> InvalidInput:
    for index, row in enumerate(rows):
        words = row.split()
        for word in words:
            if not _is_number(word):
                return table.error(index, f"{word[:_SHOWN_CHARACTERS]!r} is not a number", f"expected {layout}")
        if len(words) != columns:
            return table.error(index, f"{len(words)} columns instead of {columns}", f"expected {layout}")
    return InvalidInput(f"{table.name} is not a table of numbers", f"expected lines of {layout}")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word
