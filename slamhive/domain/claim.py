"""Numbers that papers and READMEs print, claims of them, and how far a claim holds on runs of one's own."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from enum import StrEnum

from slamhive.base.errors import InvalidInput
from slamhive.domain.gate import Margin
from slamhive.domain.metrics.model import Metric


class MetricFamily(StrEnum):
    """Kind of error that a paper prints."""

    ATE = "ate"
    ATE_ROT = "ate_rot"
    RPE = "rpe"
    RPE_ROT = "rpe_rot"
    KITTI = "kitti"
    SEGMENT = "segment"


class PrintedUnit(StrEnum):
    """Unit of a printed error."""

    M = "m"
    CM = "cm"
    MM = "mm"
    PERCENT = "%"
    DEG = "deg"
    DEG_PER_M = "deg/m"


MOST_DIGITS = 12


@dataclass(frozen=True, slots=True)
class Printed:
    """A number as a paper prints it.

    Attributes:
        value: The number.
        within: Half of its last digit: what was rounded to it differs by no more.
        unit: Its unit; None if any that is usual.
    """

    value: float
    within: float
    unit: PrintedUnit | None = None

    def shows(self, value: float) -> bool:
        """Return whether ``value``, rounded to the printed digits, is the printed number."""
        return abs(value - self.value) <= self.within * (1 + 1e-9) + 1e-15


def read_printed(text: str, unit: PrintedUnit | None = None) -> Printed:
    """Read a printed number; its digits count, so 0.0160 says more than 0.016. Raises InvalidInput."""
    try:
        number = Decimal(text.strip())
    except InvalidOperation:
        raise InvalidInput(f"{text[:40]!r} is not a number", "write it as the paper prints it, such as 0.016") from None
    if not number.is_finite() or number < 0 or abs(number.adjusted()) > MOST_DIGITS:
        raise InvalidInput(f"{text[:40]!r} cannot be an error", "write it as the paper prints it, such as 0.016")
    exponent = number.as_tuple().exponent
    return Printed(float(number), 0.5 * 10.0 ** int(exponent), unit)


# What a claim states: a printed number with its unit, and perhaps the deviation of the runs behind it.


_STATED = re.compile(r"(?P<value>[-+.\dEe]+)(\s*±\s*(?P<std>[-+.\dEe]+))?(\s*(?P<unit>[^\s\d±]\S*))?")


@dataclass(frozen=True, slots=True)
class StatedNumber:
    """A number with its unit, as a claim states it.

    Attributes:
        text: As it was written.
        printed: The number; its digits say how exact it is.
        unit: Its unit; empty for a pure number.
        factor: From the metric's own unit to this one.
        std: The standard deviation of the runs behind it; None if it is not stated.
    """

    text: str
    printed: Printed
    unit: str
    factor: float
    std: float | None = None


def read_stated(text: str, measured: Metric, units: Mapping[str, float]) -> StatedNumber:
    """Read what a claim states of a metric: ``1.6 cm``, ``0.016 ± 0.002 m``.

    Args:
        text: As the claim has it; its digits count.
        measured: The metric.
        units: The units in which it may be printed: {unit: factor to the metric's own}; empty for a pure number.

    Raises:
        InvalidInput: the text is no such number, or its unit is none of the metric.
    """
    found = _STATED.fullmatch(text.strip())
    if found is None:
        raise InvalidInput(
            f"{measured.key}: {text[:40]!r} is no number with its unit", "write '1.6 cm', '0.016 ± 0.002 m'"
        )
    unit = found["unit"] or ""
    if unit not in (units or {"": 1.0}):
        wrong = f"{unit[:20]!r} is no unit of it" if unit else f"{text[:40]!r} has no unit"
        raise InvalidInput(f"{measured.key}: {wrong}", f"use {' or '.join(units)}" if units else "leave it out")
    std = None if found["std"] is None else read_printed(found["std"]).value
    printed = read_printed(found["value"], PrintedUnit(unit) if unit in set(PrintedUnit) else None)
    return StatedNumber(text.strip(), printed, unit, 1.0 / units.get(unit, 1.0), std)


class ClaimedStatistic(StrEnum):
    """Statistic of the runs that a claim states."""

    MEAN = "mean"
    MEDIAN = "median"


@dataclass(frozen=True, slots=True)
class Claim:
    """One number that somebody has published about a system on a sequence.

    Attributes:
        algorithm: ``NAME``, or ``NAME@NUMBER`` for a version of the package here.
        version: The upstream version that it is about; None if it is not stated.
        dataset: The sequence.
        settings: What differs from the defaults, in words; empty for nothing.
        metric: Key of the metric.
        stated: The number.
        statistic: What the number is of the runs behind it.
        runs: How many runs are behind it; None if it is not stated.
        tolerance: How far our value may differ besides the rounding.
        repeats: How many runs of ours decide.
        protocol: Name of the protocol; ``default`` for that of the sensors.
        source: Where it is published.
    """

    algorithm: str
    version: str | None
    dataset: str
    settings: str
    metric: str
    stated: StatedNumber
    statistic: ClaimedStatistic
    runs: int | None
    tolerance: Margin
    repeats: int
    protocol: str
    source: str

    @property
    def margin(self) -> float:
        """Largest difference of our value, in the printed unit: the rounding and the tolerance together."""
        allowed = self.tolerance.value
        if self.tolerance.relative:
            allowed *= self.stated.printed.value
        else:
            allowed *= self.stated.factor
        return self.stated.printed.within + allowed

    @property
    def words(self) -> str:
        """Subject of the claim: ``kiss-icp on room``."""
        version = "" if self.version is None else f" {self.version}"
        return f"{self.algorithm}{version} on {self.dataset}{f' ({self.settings})' if self.settings else ''}"

    @property
    def family(self) -> MetricFamily | None:
        """The kind of error for a search of protocols; None if it follows from none, or its unit is none of theirs."""
        first, last = self.metric.split(".")[0], self.metric.rsplit(".", 1)[-1]
        family = _FAMILIES.get(first)
        fits = family in (MetricFamily.KITTI, MetricFamily.SEGMENT) or last in _STATISTICS
        return family if fits and self.stated.printed.unit is not None else None


_FAMILIES = {**{family.value: family for family in MetricFamily}, "rpe_point": MetricFamily.RPE}
_STATISTICS = ("rmse", "mean", "median", "max", "std")


class ClaimState(StrEnum):
    """State of a claim."""

    HOLDS = "holds"
    DIFFERS = "differs"
    UNDECIDED = "undecided"
    CANNOT_RUN = "cannot be run"


def claims_words(states: Iterable[ClaimState]) -> str:
    """``9 of 12 hold``."""
    counts = Counter(states)
    return f"{counts[ClaimState.HOLDS]} of {counts.total()} hold"
