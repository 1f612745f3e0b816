"""Names that users give to datasets, algorithms and parameters: one rule for all of them."""

from __future__ import annotations

import math
import re
from decimal import Decimal

from slamhive.base.errors import InvalidInput

NAME_PATTERN = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}"
_NAME = re.compile(NAME_PATTERN)


def check_name(kind: str, name: str) -> str:
    """Return ``name`` if it is safe as a folder, image tag part and URL segment; raise InvalidInput otherwise.

    At most 64 letters, digits, ``_``, ``.`` and ``-``, the first a letter or digit, no ``..``. Path separators, quotes,
    newlines and markup are therefore impossible wherever the name is used.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name) or ".." in name:
        raise InvalidInput(
            f"{kind} name {name!r} is not allowed",
            "use 1 to 64 letters, digits, '_', '.' or '-', the first a letter or digit, without '..'",
        )
    return name


# Numbers in messages, as a person would write them.


def plain(number: float) -> str:
    """``number`` exactly and without an exponent: ``10000000``, ``0.0000001``, ``1.5``."""
    text = format(Decimal(repr(number)), "f")
    return text.rstrip("0").rstrip(".") if "." in text else text


def plural(count: int, noun: str, many: str | None = None) -> str:
    """``1 run``, ``1,234 runs``; ``many`` where the plural takes more than an s."""
    return f"{count:,} {noun if count == 1 else many or noun + 's'}"


def mean_and_std(mean: float, std: float | None) -> str:
    """``0.0312 ± 0.0008``: three significant digits of the mean, one more if the spread is smaller than they show.

    Both have the same decimals. A spread too small for them has its own two digits: ``0.0191 ± 3.0e-06``. One that is
    rounding is 0. The mean alone without a standard deviation.
    """
    whole = std in (None, 0.0) and float(mean).is_integer()
    digits = 0 if whole else max(0, 2 - _exponent(mean))
    if std is None:
        return f"{mean:.{digits}f}"
    if not round(std, digits + 1):
        return f"{mean:.{digits}f} ± {'0' if std < 1e-9 * abs(mean) or not std else f'{std:#.2g}'}"
    digits = min(max(digits, -_exponent(std)), digits + 1)
    return f"{mean:.{digits}f} ± {std:.{digits}f}"


def value_within(value: float, half_width: float) -> str:
    """``0.0312 ± 0.0008``: a value with half of its interval, in the digits of :func:`mean_and_std`.

    A value below its half width has no digits beyond the first two of that: ``0.000 ± 0.012``.
    """
    if abs(value) >= half_width or not half_width:
        return mean_and_std(value, half_width)
    digits = max(0, 1 - _exponent(half_width))
    return f"{round(value, digits) + 0.0:.{digits}f} ± {half_width:.{digits}f}"


def _exponent(value: float) -> int:
    return math.floor(math.log10(abs(value))) if value else 0


def printable(text: str) -> str:
    """``text`` from outside with a blank in the place of each character that cannot be printed, line ends included."""
    return "".join(character if character.isprintable() else " " for character in text)
