"""Numbers, units and times as users type them in filters."""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime, timedelta

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", re.ASCII)
_NUMBER_AND_UNIT = re.compile(rf"({_NUMBER.pattern})\s*(\S*)", re.ASCII)
_DAY = re.compile(r"\d{4}-\d\d-\d\d", re.ASCII)
_MOMENT = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d{1,6})?)?(Z|[+-]\d\d:\d\d)?", re.ASCII)

_SCALES: dict[str, dict[str, float]] = {
    "s": {"us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0},
    "m": {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3},
    "bytes": {
        "bytes": 1.0,
        "B": 1.0,
        "kB": 1e3,
        "MB": 1e6,
        "GB": 1e9,
        "TB": 1e12,
        "KiB": 2.0**10,
        "MiB": 2.0**20,
        "GiB": 2.0**30,
    },
    "rad": {"rad": 1.0, "deg": math.pi / 180, "°": math.pi / 180},
    "deg": {"deg": 1.0, "°": 1.0, "rad": 180 / math.pi},
    "": {"%": 0.01},
    "Hz": {"Hz": 1.0, "kHz": 1e3},
    "MB": {"kB": 1e-3, "MB": 1.0, "GB": 1e3},
    "cores": {"cores": 1.0, "core": 1.0},
}
"""{unit a metric is stored in: {unit that may be typed: factor to the stored one}}."""

UNITS = frozenset(unit for scales in _SCALES.values() for unit in scales) | {"%"}
"""Words that are read as a unit after a number."""


def is_number(text: str) -> bool:
    """Whether ``text`` is a plain number."""
    return _NUMBER.fullmatch(text) is not None


def units_of(stored: str) -> dict[str, float]:
    """The units in which a metric stored in ``stored`` can be compared, with their factors."""
    return _SCALES.get(stored, {stored: 1.0} if stored else {})


def number(text: str, stored_unit: str) -> float | None:
    """``text`` (``0.1``, ``1e-3``, ``50 ms``) in ``stored_unit``; None if it is no such number."""
    match = _NUMBER_AND_UNIT.fullmatch(text)
    if match is None:
        return None
    factor = 1.0 if not match[2] else units_of(stored_unit).get(match[2])
    if factor is None:
        return None
    value = float(match[1])
    value = value if factor == 1.0 else value * factor
    return value if math.isfinite(value) else None


def moments(text: str) -> tuple[datetime, datetime] | None:
    """The first moment of what ``text`` names, a UTC day or one microsecond, and the first after it; or None."""
    try:
        if _DAY.fullmatch(text):
            day = datetime.fromisoformat(text).replace(tzinfo=UTC)
            return day, day + timedelta(days=1)
        if _MOMENT.fullmatch(text):
            at = datetime.fromisoformat(text)
            at = at.replace(tzinfo=UTC) if at.tzinfo is None else at.astimezone(UTC)
            return at, at + timedelta(microseconds=1)
    except (ValueError, OverflowError):
        return None
    return None
