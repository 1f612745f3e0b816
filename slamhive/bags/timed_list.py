"""Lists with a timestamp in each row: image lists, IMU samples and poses as text or CSV.

TUM RGB-D writes ``seconds file``, EuRoC ``nanoseconds,value,...``. Timestamps become whole nanoseconds without
rounding: a float64 holds those of today only to 256 ns.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path, PurePosixPath

import numpy as np

from slamhive.bags.geometry import Array
from slamhive.bags.losses import Loss
from slamhive.errors import InvalidInput, NotFound
from slamhive.trajectory.layout import TimeUnit
from slamhive.trajectory.table import read_bounded

_SHOWN = 60
_MOST_NS = 2**31 * 10**9
"""ROS 2 holds seconds in 32 bits with a sign."""
_DIGITS_TO_NS = {TimeUnit.S: 9, TimeUnit.MS: 6, TimeUnit.US: 3, TimeUnit.NS: 0}


@dataclass(frozen=True, eq=False)
class TimedList:
    """The rows of a file in the order of time.

    Attributes:
        path: The file.
        times_ns: Timestamps, int64 (n,), increasing.
        rows: The other columns of each row as text.
        line_numbers: The line of each row, from 1.
        repeated: How many rows were left out because their timestamp equals that of the row before.
    """

    path: Path
    times_ns: Array
    rows: list[list[str]]
    line_numbers: list[int]
    repeated: int = 0

    def __len__(self) -> int:
        return len(self.rows)

    def numbers(self, start: int, count: int) -> Array:
        """The columns ``start`` to ``start + count`` after the timestamp, float64 (n, count); raises InvalidInput."""
        try:
            values = np.array([row[start : start + count] for row in self.rows], dtype=np.float64)
        except ValueError:
            values = np.array([[self._number(index, word) for word in row] for index, row in self._part(start, count)])
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            index, column = (int(place) for place in bad[0])
            raise self.error(index, f"{self.rows[index][start + column]!r} is not finite", "leave out such rows")
        return values

    def files(self, folder: Path, column: int = 0) -> tuple[TimedList, list[Path]]:
        """The rows whose file exists, and these files; raises InvalidInput if there is none.

        Names are relative to ``folder`` and cannot leave it.
        """
        paths = [folder / self._relative(index, row[column]) for index, row in enumerate(self.rows)]
        kept = [index for index, path in enumerate(paths) if path.is_file()]
        if not kept:
            raise InvalidInput(f"none of the {len(self)} files that {self.path} lists exists", f"expected {paths[0]}")
        return self.take(kept), [paths[index] for index in kept]

    def take(self, indices: list[int]) -> TimedList:
        """The rows at ``indices``."""
        rows, lines = [self.rows[index] for index in indices], [self.line_numbers[index] for index in indices]
        return TimedList(self.path, self.times_ns[indices], rows, lines, self.repeated)

    def notes(self, kept: TimedList | None = None) -> tuple[str, ...]:
        """What is left out, for users; ``kept`` are the rows whose files exist."""
        missing = 0 if kept is None else len(self) - len(kept)
        name, listed = self.path.name, len(self)
        found = (
            (missing, listed, f"{missing} of the {listed} files that {name} lists are missing and left out"),
            (
                self.repeated,
                listed + self.repeated,
                f"{self.repeated} rows of {name} repeat a timestamp and are left out",
            ),
        )
        return tuple(Loss(*entry) for entry in found if entry[0])

    def error(self, index: int, found: str, remedy: str) -> InvalidInput:
        """An error about row ``index``."""
        return InvalidInput(f"{self.path}, line {self.line_numbers[index]}: {found}", remedy)

    def _part(self, start: int, count: int) -> list[tuple[int, list[str]]]:
        return [(index, row[start : start + count]) for index, row in enumerate(self.rows)]

    def _number(self, index: int, word: str) -> float:
        try:
            return float(word)
        except ValueError:
            raise self.error(index, f"{word[:_SHOWN]!r} is not a number", "correct the line") from None

    def _relative(self, index: int, name: str) -> PurePosixPath:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or not path.parts or not name.isprintable():
            raise self.error(index, f"{name[:_SHOWN]!r} is no file in the folder", "write a path below the folder")
        return path


def read_timed_list(path: Path, layout: str, unit: TimeUnit, *, columns: int | None = None) -> TimedList:
    """Read the rows of ``path``: words separated by commas or blanks, the first a timestamp.

    ``#`` starts a comment line. A first line without a number is a header. Rows may have more columns than wanted.

    Args:
        path: The file.
        layout: The columns in words, for messages.
        unit: Of the timestamps.
        columns: How many words a row has at least; by default as many as ``layout`` names.

    Raises:
        InvalidInput: There is no such file, no row, or a bad row, named by its line.
    """
    return parse_timed_list(_lines(path), path, layout, unit, columns=columns or len(layout.replace(",", " ").split()))


def parse_timed_list(lines: list[str], path: Path, layout: str, unit: TimeUnit, *, columns: int) -> TimedList:
    """As :func:`read_timed_list`, of ``lines`` that were read from ``path``."""
    times_ns: list[int] = []
    rows: list[list[str]] = []
    numbers: list[int] = []
    repeated = 0
    for number, line in enumerate(lines, start=1):
        words = _words(line)
        if not words or (number == 1 and not _is_number(words[0])):
            continue
        time_ns = _time_ns(words, unit, f"{path}, line {number}", layout, columns)
        if times_ns and time_ns < times_ns[-1]:
            raise InvalidInput(
                f"{path}, line {number}: timestamp {words[0]} comes after {rows[-1][0]}", "sort the rows by timestamp"
            )
        if times_ns and time_ns == times_ns[-1]:
            repeated += 1
            continue
        times_ns.append(time_ns)
        rows.append(words)
        numbers.append(number)
    if not rows:
        raise InvalidInput(f"{path} has no rows", f"expected lines of {layout}")
    return TimedList(path, np.array(times_ns, dtype=np.int64), [row[1:] for row in rows], numbers, repeated)


def read_lines(path: Path) -> list[str]:
    """The lines of a text file; raises InvalidInput for a file that is absent, no text or too large."""
    return _lines(path)


def _lines(path: Path) -> list[str]:
    try:
        return read_bounded(path).decode("utf-8-sig").splitlines()
    except NotFound:
        raise InvalidInput(f"{path} does not exist", "complete the folder") from None
    except UnicodeDecodeError as error:
        raise InvalidInput(f"{path} is not a text file: byte {error.start} is no UTF-8") from None


def _words(line: str) -> list[str]:
    content = line.strip()
    if not content or content.startswith("#"):
        return []
    return [word.strip() for word in content.split(",")] if "," in content else content.split()


def _is_number(word: str) -> bool:
    try:
        Decimal(word)
    except InvalidOperation:
        return False
    return True


def _time_ns(words: list[str], unit: TimeUnit, place: str, layout: str, columns: int) -> int:
    if len(words) < columns:
        raise InvalidInput(f"{place}: {len(words)} columns, not {columns}", f"expected {layout}")
    try:
        time = Decimal(words[0])
    except InvalidOperation:
        raise InvalidInput(f"{place}: timestamp {words[0][:_SHOWN]!r} is not a number", f"expected {layout}") from None
    time_ns = round(time.scaleb(_DIGITS_TO_NS[unit])) if time.is_finite() and abs(time.adjusted()) < 30 else -1
    if not 0 <= time_ns < _MOST_NS:
        raise InvalidInput(f"{place}: timestamp {words[0][:_SHOWN]} {unit} is out of range", f"expected {layout}")
    return time_ns
