"""How long something will still take: the expected time, and the interval that it lies in nine times of ten."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Remaining:
    """Seconds. ``low_s`` and ``high_s`` are None while nothing like it was measured."""

    seconds: float
    low_s: float | None = None
    high_s: float | None = None

    def __add__(self, other: Remaining) -> Remaining:
        """One after the other. A part without an interval counts with its expected time."""
        if self.low_s is None and other.low_s is None:
            return Remaining(self.seconds + other.seconds)
        lows, highs = zip(self._ends(), other._ends(), strict=True)
        return Remaining(self.seconds + other.seconds, sum(lows), sum(highs))

    def words(self, including: str = "") -> str:
        """``9 to 16 min left``, or ``about 13 min left, not measured yet``; ``including`` comes after ``left``."""
        return f"{self.span} left{including}{', not measured yet' if self.low_s is None else ''}"

    @property
    def span(self) -> str:
        """``9 to 16 min``; ``about 13 min`` without an interval, or if both ends are alike."""
        low, high = map(rounded, self._ends())
        if low == high:
            return f"about {high}"
        number, _, unit = low.partition(" ")
        return f"{number if high.endswith(f' {unit}') else low} to {high}"

    def _ends(self) -> tuple[float, float]:
        if self.low_s is None or self.high_s is None:
            return self.seconds, self.seconds
        return self.low_s, self.high_s


def rounded(seconds: float) -> str:
    """A time no more exact than it is known: ``45 s``, ``2.5 min``, ``13 min``, ``1.6 h``, ``3.2 d``."""
    if seconds < 57.5:
        return f"{max(5, round(seconds / 5) * 5)} s"
    if seconds < 5400:
        return _number(seconds / 60, 3, "min")
    if seconds < 172_800:
        return _number(seconds / 3600, 10, "h")
    return _number(seconds / 86_400, 10, "d")


def _number(amount: float, exact_below: float, unit: str) -> str:
    """One decimal for small numbers, none for others."""
    return f"{amount:.1f} {unit}" if amount < exact_below else f"{amount:.0f} {unit}"
