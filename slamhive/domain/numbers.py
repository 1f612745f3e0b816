"""Numbers in messages, as a person would write them."""

from __future__ import annotations

from decimal import Decimal


def plain(number: float) -> str:
    """``number`` exactly and without an exponent: ``10000000``, ``0.0000001``, ``1.5``."""
    text = format(Decimal(repr(number)), "f")
    return text.rstrip("0").rstrip(".") if "." in text else text


def plural(count: int, noun: str, many: str | None = None) -> str:
    """``1 run``, ``1,234 runs``; ``many`` where the plural takes more than an s."""
    return f"{count:,} {noun if count == 1 else many or noun + 's'}"
