"""Numbers and lists for the YAML files of other formats, which are written line by line as their tools write them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def number(value: Any) -> str:
    """A number that YAML 1.1 reads as one too: an exponent needs a decimal point there."""
    text = repr(float(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def numbers(values: Iterable[Any]) -> str:
    """A list of numbers in one line."""
    return f"[{', '.join(number(value) for value in values)}]"
