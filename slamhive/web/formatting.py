"""Numbers, times and sizes as text: short on the page, exact on hover."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

from slamhive.domain.metrics import Metric
from slamhive.domain.names import mean_and_std, plural

DASH = "–"
PERCENT_METRICS = frozenset(
    {
        "cpu.limit_used",
        "deadline.missed_fraction",
        "disturbance.cpu_pressure",
        "disturbance.io_pressure",
        "disturbance.memory_pressure",
        "disturbance.steal_fraction",
        "frames.dropped_fraction",
        "gpu.utilisation_max",
        "gpu.utilisation_mean",
        "map.localised_fraction",
        "nees.orientation.within",
        "nees.position.within",
        "relations.matched_fraction",
        "tracked.path",
        "tracked.time",
        "tracked_fraction",
        *(f"map.{kind}.{size}" for kind in ("accuracy", "completeness", "fscore") for size in ("5cm", "10cm", "20cm")),
    }
)
"""Shares, which are stored as 0 to 1."""


@dataclass(frozen=True, slots=True)
class TableCell:
    """A table cell: ``text`` with a smaller ``note`` after it, and ``exact`` on hover.

    ``heat`` is the level of its background, from 0 (best) to 6 (worst); None without one.
    """

    text: str
    exact: str = ""
    missing: bool = False
    note: str = ""
    heat: int | None = None


@dataclass(frozen=True, slots=True)
class DisplayUnit:
    """The unit in which pages show a metric, and the factor from its stored unit."""

    unit: str
    factor: float = 1.0


def display_unit(metric: Metric) -> DisplayUnit:
    """Bytes are shown in MB and shares in percent; other units as stored."""
    if metric.key in PERCENT_METRICS:
        return DisplayUnit("%", 100.0)
    if metric.unit == "bytes":
        return DisplayUnit("MB", 1e-6)
    return DisplayUnit(metric.unit)


def metric_cell(metric: Metric, value: float | None) -> TableCell:
    """A value with three significant digits; the stored value and its unit on hover."""
    if value is None:
        return TableCell(DASH, f"no {metric.label} known", missing=True)
    shown = display_unit(metric)
    return TableCell(significant(value * shown.factor), f"{value!r} {metric.unit}".strip())


def mean_text(mean: float, std: float | None) -> str:
    """``0.112 ± 0.010`` as :func:`mean_and_std` writes it, or the value of a single run."""
    return significant(mean) if std is None else mean_and_std(mean, std)


def median_text(n: int, median: float) -> str:
    """``median 0.11``; empty for one or two values, where it equals the mean."""
    return f"median {significant(median)}" if n > 2 else ""


def significant(value: float, digits: int = 3) -> str:
    """``value`` with ``digits`` significant digits; no exponent between 1e-4 and 1e7. Integers keep all digits."""
    if not math.isfinite(value):
        return str(value)
    if value == int(value) and abs(value) < 1e7:
        return thousands(int(value))
    if not 1e-4 <= abs(value) < 1e7:
        return f"{value:.{digits - 1}e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:,.{decimals}f}"


def thousands(value: int) -> str:
    """``1,234``."""
    return f"{value:,}"


def duration(seconds: float | None) -> str:
    """``0.42 s``, ``12.3 s``, ``3 min 05 s``, ``2 h 04 min``, ``3 d 02 h``."""
    if seconds is None:
        return DASH
    if seconds < 10:
        return f"{seconds:.2f} s"
    if seconds < 99.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    if whole < 86_400:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole // 86_400} d {whole % 86_400 // 3600:02d} h"


def size(count_bytes: float | None) -> str:
    """``512 bytes``, ``1.21 GB``; decimal units."""
    if count_bytes is None:
        return DASH
    amount = float(count_bytes)
    if amount < 1000:
        return plural(int(amount), "byte")
    for unit in ("kB", "MB", "GB"):
        amount /= 1000
        if amount < 999.5:
            return f"{amount:.3g} {unit}"
    return f"{amount / 1000:.3g} TB"


def exact_time(at: datetime | None) -> str:
    """``2026-01-31 12:00:00 UTC``."""
    return "" if at is None else at.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def iso_time(at: datetime) -> str:
    """For the ``datetime`` attribute of HTML."""
    return at.astimezone(UTC).isoformat(timespec="seconds")


def relative_time(at: datetime | None, now: datetime) -> str:
    """``just now``, ``5 min ago``, ``in 3 h``; the date if it is more than a month away."""
    if at is None:
        return DASH
    seconds = abs((now - at).total_seconds())
    if seconds < 10:
        return "just now"
    for below_s, unit_s, unit in ((60, 1, "s"), (3600, 60, "min"), (86_400, 3600, "h"), (30 * 86_400, 86_400, "d")):
        if seconds < below_s:
            amount = f"{int(seconds // unit_s)} {unit}"
            return f"{amount} ago" if at < now else f"in {amount}"
    return at.astimezone(UTC).strftime("%Y-%m-%d")


def value_text(value: object) -> str:
    """A parameter value as a user would type it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple | list):
        return ", ".join(value_text(part) for part in value)
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    return str(value)
