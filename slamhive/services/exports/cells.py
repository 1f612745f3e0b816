"""Cells of tables that spreadsheets open."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")
_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "\n")


def safe_cell(value: T) -> T | str:
    """``value``; text that a spreadsheet would run as a formula gets a quotation mark before it."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA_STARTS) else value
