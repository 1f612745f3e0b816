"""Reads tables of numbers from text files; errors name the line."""

from __future__ import annotations

import codecs
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import numpy.typing as npt

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.trajectory.model import FloatArray

IntArray = npt.NDArray[np.int64]

MAX_FILE_BYTES = 200_000_000
"""Longer files are refused: at 100 bytes a pose this is two million poses."""

MOST_ROWS = 2_500_000
"""Files with more are refused: 23 hours at 30 Hz. A row takes memory even if it holds little text."""
LONGEST_LINE = 10_000_000
_BLOCK_BYTES = 1 << 20
_SHOWN_CHARACTERS = 40


@dataclass(frozen=True, slots=True)
class NumberTable:
    """The numbers of a text file, and its text.

    Attributes:
        name: The file, as messages shall call it.
        values: Shape (rows, columns).
    """

    name: str
    values: FloatArray
    _data: bytes
    _taken: IntArray | None = None
    """The rows of the file that are left, None for all."""

    def line_number(self, row: int) -> int:
        """The line of row ``row`` in the file, from 1."""
        wanted = row if self._taken is None else self._taken[row]
        lines = chain.from_iterable(_lines(self._data, self.name))
        holding = (number for number, line in enumerate(lines, start=1) if _is_row(line))
        return next(number for index, number in enumerate(holding) if index == wanted)

    @property
    def places(self) -> IntArray:
        """The place of each row in a list whose lines belong to frames, from 0, shape (rows,).

        A blank line between rows stands for a frame of which nothing is known. Comments, and blank lines next to
        those above the first row, are no places.
        """
        found: list[int] = []
        place = 0
        for line in chain.from_iterable(_lines(self._data, self.name)):
            if _is_row(line):
                found.append(place)
            elif line.strip():
                place = place if found else 0
                continue
            place += 1
        places = np.array(found, dtype=np.int64)
        return places if self._taken is None else places[self._taken]

    def take(self, rows: IntArray) -> NumberTable:
        """The table without its other rows; lines and places stay those of the file."""
        taken = rows if self._taken is None else self._taken[rows]
        return NumberTable(self.name, self.values[rows], self._data, taken)

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
    _check_text(data, name, layout)
    rows = _rows(data, name)
    first = next(rows, None)
    if first is None:
        raise InvalidInput(f"{name} is empty: it holds no line of numbers", f"expected lines of {layout}")
    try:
        values = np.loadtxt(chain([first], rows), dtype=np.float64, comments=None, ndmin=2)
    except ValueError:
        values = np.empty((0, 0))
    if values.shape[1] == columns:
        return NumberTable(name, values, data)
    if more_columns and values.shape[1] > columns:
        return NumberTable(name, values[:, :columns], data)
    if more_columns:
        columns = max(columns, len(first.split()))
    unread = NumberTable(name, values, data)
    for index, row in enumerate(_rows(data, name)):
        words = row.split()
        for word in words:
            if not _is_number(word):
                raise unread.error(index, f"{word[:_SHOWN_CHARACTERS]!r} is not a number", f"expected {layout}")
        if len(words) != columns:
            raise unread.error(index, f"{len(words)} columns instead of {columns}", f"expected {layout}")
    raise InvalidInput(f"{name} is not a table of numbers", f"expected lines of {layout}")


def _check_text(data: bytes, name: str, layout: str) -> None:
    """Raise InvalidInput unless ``data`` is text. It is decoded in blocks: as a whole, it would take its size again."""
    decoder, done = codecs.getincrementaldecoder("utf-8-sig")(), 0
    place = data.find(b"\0")
    try:
        for start in range(0, len(data), _BLOCK_BYTES):
            done = start - len(decoder.getstate()[0])
            decoder.decode(data[start : start + _BLOCK_BYTES], final=start + _BLOCK_BYTES >= len(data))
    except UnicodeDecodeError as error:
        place = done + error.start
    if place >= 0:
        found = f"byte 0x{data[place]:02x} at position {place}"
        raise InvalidInput(f"{name} is not a text file: {found}", f"expected lines of {layout}")


def _lines(data: bytes, name: str) -> Iterator[list[str]]:
    """The lines, some thousand at a time: all at once would take many times the memory of their numbers.

    Raises InvalidInput for a line that is too long to be a row.
    """
    decoder, rest = codecs.getincrementaldecoder("utf-8-sig")(), ""
    for start in range(0, len(data), _BLOCK_BYTES):
        last = start + _BLOCK_BYTES >= len(data)
        text = rest + decoder.decode(data[start : start + _BLOCK_BYTES], final=last)
        # The last line may go on in the next block, or end there: "\r\n" is one end.
        rest = "" if last or not text else text.splitlines(keepends=True)[-1]
        if len(rest) > LONGEST_LINE:
            raise InvalidInput(f"{name} has a line of more than {LONGEST_LINE:,} characters", "write one row a line")
        yield text[: len(text) - len(rest)].splitlines()


def text_lines(data: bytes, name: str, layout: str) -> Iterator[str]:
    """All lines of a file of text that is no table; raises InvalidInput if it is no text, or has too many lines."""
    _check_text(data, name, layout)
    for number, line in enumerate(chain.from_iterable(_lines(data, name)), start=1):
        if number > 2 * MOST_ROWS:
            raise InvalidInput(f"{name} has more than {2 * MOST_ROWS:,} lines", "split it, or write less")
        yield line


def _rows(data: bytes, name: str) -> Iterator[str]:
    """The lines that hold numbers, separated by blanks; raises InvalidInput if there are too many."""
    commas, count = b"," in data, 0
    for lines in _lines(data, name):
        rows = [line for line in lines if _is_row(line)]
        count += len(rows)
        if count > MOST_ROWS:
            raise InvalidInput(f"{name} has more than {MOST_ROWS:,} rows", "split it, or write less")
        yield from (row.replace(",", " ") for row in rows) if commas else rows


def _is_row(line: str) -> bool:
    content = line.lstrip()
    return content != "" and content[0] != "#"


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word
