"""Mean and spread of a group of runs as text, in the units that tables show."""

from __future__ import annotations

import math

import pandas as pd

from slamhive.analysis.plot_types import base
from slamhive.analysis.statistics import Summary, summarise
from slamhive.analysis.table import Column


def shown_unit(column: Column) -> str:
    """The unit of the texts of :func:`mean_and_std`: MB for bytes, nothing for shares and counts."""
    return "MB" if column.unit == "bytes" else "" if column.unit == "1" else column.unit


def summary_of(group: pd.DataFrame, column: Column) -> Summary | None:
    """The values of the runs that did not fail, in the unit of :func:`shown_unit`; None if there are none."""
    scale = base.MEGABYTES_PER_BYTE if column.unit == "bytes" else 1.0
    return summarise(scale * base.good_values(group, column.key))


def mean_and_std(summary: Summary) -> str:
    """``0.0312 ± 0.0008``: three significant digits of the mean, one more if the spread is smaller than they show."""
    whole = summary.std in (None, 0.0) and summary.mean.is_integer()
    digits = 0 if whole else max(0, 2 - _exponent(summary.mean))
    if summary.std and round(summary.std, digits + 1):
        digits = min(max(digits, -_exponent(summary.std)), digits + 1)
    if summary.std is None:
        return f"{summary.mean:.{digits}f}"
    return f"{summary.mean:.{digits}f} ± {summary.std:.{digits}f}"


def _exponent(value: float) -> int:
    return math.floor(math.log10(abs(value))) if value else 0
