"""Table cells that are safe to open in a spreadsheet."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")
_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "\n")


def safe_cell(value: T) -> T | str:
    """Put an apostrophe before text that a spreadsheet would run as a formula."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA_STARTS) else value
