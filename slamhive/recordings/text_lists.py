"""Lists with a timestamp in each row: image lists, IMU samples, poses and ground truth as text or CSV.

TUM RGB-D writes ``seconds file``, EuRoC ``nanoseconds,value,...``. Timestamps become whole nanoseconds without
rounding: a float64 holds those of today only to 256 ns.
"""

from __future__ import annotations

import bz2
import gzip
import math
import zlib
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path, PurePosixPath
from typing import IO

import numpy as np

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.recordings.geometry import Array
from slamhive.recordings.importing import Loss, PlannedTruth
from slamhive.recordings.writers import NS_PER_S
from slamhive.trajectory.layout import TimeUnit
from slamhive.trajectory.model import find_problem, no_rotations
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
        """Note on rows that are left out, for users; ``kept`` are the rows whose files exist."""
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


def listed_truth(rows: TimedList, quats_xyzw: Array | None, source: str, *, gravity_aligned: bool) -> PlannedTruth:
    """The poses of a list whose first three columns are x, y, z in m; raises InvalidInput naming the line.

    Args:
        rows: The list.
        quats_xyzw: Unit quaternions (n, 4), None for positions only.
        source: What measured them.
        gravity_aligned: The z axis of the world points up.
    """
    times_s, positions_m = rows.times_ns / NS_PER_S, rows.numbers(0, 3)
    if quats_xyzw is not None and not quats_xyzw.any():
        quats_xyzw = None
    quats = no_rotations(len(rows)) if quats_xyzw is None else quats_xyzw
    problem = find_problem(times_s, positions_m, quats)
    if problem is not None:
        raise rows.error(problem.index, problem.found, problem.remedy)
    unit = None if quats_xyzw is None else quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return PlannedTruth(times_s, positions_m, unit, gravity_aligned=gravity_aligned, source=source)


def parse_timed_list(lines: list[str], path: Path, layout: str, unit: TimeUnit, *, columns: int) -> TimedList:
    """The same as :func:`read_timed_list`, of ``lines`` that were read from ``path``."""
    times_ns: list[int] = []
    rows: list[list[str]] = []
    numbers: list[int] = []
    repeated = 0
    for number, line in enumerate(lines, start=1):
        words = _words(line)
        if not words or (number == 1 and not _is_number(words[0])):
            continue
        place = f"{path}, line {number}"
        if len(words) < columns:
            raise InvalidInput(f"{place}: {len(words)} columns, not {columns}", f"expected {layout}")
        try:
            time = Decimal(words[0])
        except InvalidOperation:
            raise InvalidInput(
                f"{place}: timestamp {words[0][:_SHOWN]!r} is not a number", f"expected {layout}"
            ) from None
        time_ns = round(time.scaleb(_DIGITS_TO_NS[unit])) if time.is_finite() and abs(time.adjusted()) < 30 else -1
        if not 0 <= time_ns < _MOST_NS:
            raise InvalidInput(f"{place}: timestamp {words[0][:_SHOWN]} {unit} is out of range", f"expected {layout}")
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


# Reads text logs line by line: words between blanks or commas, with errors that name the line.


_MOST_CHARACTERS = 200_000
_LATEST_S = 2**31
_OPENERS: dict[str, Callable[..., IO[str]]] = {".bz2": bz2.open, ".gz": gzip.open}


@dataclass(frozen=True, slots=True)
class TextLine:
    """A line of the log: its number from 1 and its words."""

    path: Path
    number: int
    words: Sequence[str]

    def numbers(self, start: int, count: int, what: str) -> list[float]:
        """``count`` finite numbers from word ``start``; raises InvalidInput naming the line and the word."""
        words = self.words[start : start + count]
        if len(words) < count:
            raise self.error(f"{self.words[0]} ends within {what}", "is the log truncated?")
        try:
            values = [float(word) for word in words]
        except ValueError:
            word = next(word for word in words if not _is_float(word))
            raise self.error(f"{word[:40]!r} in {what} is not a number", "correct or remove the line") from None
        if not all(map(math.isfinite, values)):
            raise self.error(f"a number in {what} is not finite", "correct or remove the line")
        return values

    def count(self, place: int, most: int) -> int:
        """The number of readings at word ``place``, 0 to ``most``."""
        (value,) = self.numbers(place, 1, "the number of readings")
        if not 0 <= value <= most or value != int(value):
            raise self.error(f"{self.words[place][:40]} readings", f"expected a whole number up to {most}")
        return int(value)

    def time_s(self, place: int) -> float:
        """The time at word ``place``."""
        (value,) = self.numbers(place, 1, "the timestamp")
        if not 0 <= value < _LATEST_S:
            raise self.error(f"timestamp {value:g} s is out of range", f"expected 0 to {_LATEST_S}")
        return value

    def error(self, found: str, remedy: str) -> InvalidInput:
        """An error about this line."""
        return InvalidInput(f"{self.path}, line {self.number}: {found}", remedy)


class Track:
    """Rows of numbers in the order of their times; of rows with one time, the first is kept.

    Loggers write what several programs send, so rows may come late.
    """

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self._times_s, self._values = array("d"), array("d")

    def add(self, time_s: float, values: Sequence[float]) -> None:
        """Add a row."""
        self._times_s.append(time_s)
        self._values.extend(values)

    @property
    def kept(self) -> Array:
        """The rows that are kept, numbered as they were added, in the order of time, int64 (n,)."""
        rows: Array = np.unique(np.array(self._times_s), return_index=True)[1]
        return rows

    def __len__(self) -> int:
        return len(self.kept)

    def notes(self, rows: str) -> tuple[str, ...]:
        """The ``rows``, as messages call them, are left out or were out of order."""
        added, kept = len(self._times_s), self.kept
        repeated, late = added - len(kept), int(np.count_nonzero(np.diff(kept) < 0))
        found: list[str] = []
        if repeated:
            steps_s = np.diff(self.times_s)
            # Logs whose times were printed with six digits repeat a few, some thousand seconds apart.
            rounded = f" (times are in steps of {steps_s.min():g} s)" if repeated > len(kept) > 1 else ""
            note = f"{repeated} of {added} {rows} have the time of another and are left out{rounded}"
            found.append(Loss(repeated, added, note))
        if late:
            found.append(f"{late} {rows} stand after later ones: sorted by time")
        return tuple(found)

    @property
    def times_s(self) -> Array:
        """Times (n,) in s."""
        return np.array(self._times_s)[self.kept]

    @property
    def times_ns(self) -> Array:
        """Times (n,), int64."""
        times_ns: Array = np.rint(self.times_s * NS_PER_S).astype(np.int64)
        return times_ns

    @property
    def values(self) -> Array:
        """The rows (n, columns)."""
        return np.array(self._values).reshape(len(self._times_s), self._columns)[self.kept]


def lines(path: Path) -> Iterator[TextLine]:
    """The lines with content, of files that may be compressed (``.bz2``, ``.gz``); ``#`` starts a comment.

    Raises InvalidInput for a damaged file, and for lines of more than 200,000 characters.
    """
    opener = _OPENERS.get(path.suffix, open)
    try:
        with opener(path, "rt", encoding="utf-8", errors="replace") as stream:
            number = 0
            while text := stream.readline(_MOST_CHARACTERS):
                number += 1
                if len(text) == _MOST_CHARACTERS:
                    raise InvalidInput(
                        f"{path}, line {number} has over {_MOST_CHARACTERS} characters", "is this a text file?"
                    )
                words = text.replace(",", " ").split()
                if words and not words[0].startswith("#"):
                    yield TextLine(path, number, words)
    except (OSError, EOFError, zlib.error) as error:
        raise InvalidInput(f"{path} cannot be read: {error}", "copy or download the file again") from None


def _is_float(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
