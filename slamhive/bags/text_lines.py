"""Reads text logs line by line: words between blanks or commas, with errors that name the line."""

from __future__ import annotations

import bz2
import gzip
import math
import zlib
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from slamhive.bags.bag_writer import NS_PER_S
from slamhive.bags.geometry import Array
from slamhive.bags.losses import Loss
from slamhive.errors import InvalidInput

_MOST_CHARACTERS = 200_000
_LATEST_S = 2**31
_OPENERS: dict[str, Callable[..., IO[str]]] = {".bz2": bz2.open, ".gz": gzip.open}


@dataclass(frozen=True, slots=True)
class Line:
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
            word = next(word for word in words if not _is_number(word))
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


def lines(path: Path) -> Iterator[Line]:
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
                    yield Line(path, number, words)
    except (OSError, EOFError, zlib.error) as error:
        raise InvalidInput(f"{path} cannot be read: {error}", "copy or download the file again") from None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
