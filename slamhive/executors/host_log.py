"""Writes the counters of the machine beside a run to ``host.csv``, wherever they were read."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from slamhive.base.errors import Unavailable
from slamhive.executors.base import EngineUnavailable
from slamhive.executors.host_counters import HostReading
from slamhive.run_folder.host_columns import COLUMNS, NOT_MEASURED
from slamhive.run_folder.outcome import printable

logger = logging.getLogger(__name__)

HEADER = ",".join(COLUMNS) + "\n"
_MOST_MISSING = 20

ReadHost = Callable[[float, float], HostReading | None]
"""The newest reading, from seconds since the run's start and the CPU time (s) of the run; None before the first.

Raises Unavailable, with the reason, if there will never be one.
"""


class HostLog:
    """Appends the readings to ``host.csv``, each once; where there are none, one line that says why.

    Args:
        path: ``host.csv``.
        read: Where they come from.
    """

    def __init__(self, path: Path, read: ReadHost) -> None:
        self._path = path
        self._read = read
        self._last_s = float("-inf")
        self._told: set[str] = set()
        self._given_up = False

    def sample(self, time_s: float, run_cpu_s: float) -> None:
        """Append the newest reading; the arguments are those of :data:`ReadHost`. Raises EngineUnavailable."""
        if self._given_up:
            return
        try:
            reading = self._read(time_s, run_cpu_s)
        except EngineUnavailable:
            raise  # it may answer again
        except Unavailable as error:
            self._given_up = True
            self._append(f"{NOT_MEASURED}{error}\n")
            return
        if reading is not None:
            self._note(reading)

    def _note(self, reading: HostReading) -> None:
        read_at_s = reading.values[0]
        if read_at_s is None or read_at_s <= self._last_s:
            return
        self._last_s = read_at_s
        row = ",".join("" if value is None else str(round(value, 6)) for value in reading.values)
        news = {what: why for what, why in reading.missing.items() if what not in self._told}
        self._told.update(news)
        self._append(row + "\n" + "".join(f"{NOT_MEASURED}{what}: {why}\n" for what, why in news.items()))

    def _append(self, text: str) -> None:
        try:
            new = not self._path.exists()
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(HEADER + text if new else text)
        except OSError as error:
            self._given_up = True
            logger.warning("%s: the machine is not measured: %s", self._path, error.strerror)


def handed_over(content: Any) -> HostReading | None:
    """The reading whose :attr:`~slamhive.executors.host_counters.HostReading.content` came from the run's machine.

    None if there is none yet. The algorithm may have forged it: raises Unavailable if it makes no sense.
    """
    if content is None:
        return None
    try:
        values = tuple(None if value is None else _counter(value) for value in content["values"])
        missing = {printable(str(what)): printable(str(why)) for what, why in content["missing"].items()}
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError):
        raise Unavailable(_NO_SENSE) from None
    if len(values) != len(COLUMNS) or values[0] is None or len(missing) > _MOST_MISSING:
        raise Unavailable(_NO_SENSE)
    return HostReading(values, missing)


_NO_SENSE = "the counters that the run's machine handed over make no sense"


def _counter(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number) or number < 0:
        raise ValueError(value)
    return number
