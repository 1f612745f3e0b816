"""Value expressions: ``a | b | c``, ``500:2500:250``, ``lin(0, 1, 5)``, ``log(0.001, 1, 4)``, or a plain list.

An expression means the same for every parameter. Numbers without point or exponent are integers. The parameter that
takes the values gives them their type (:meth:`slamhive.domain.parameters.Parameter.parse`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from fractions import Fraction

from slamhive.base.errors import InvalidInput
from slamhive.domain.parameters import Parameter, ParameterType, Scalar, Value

MAX_VALUES = 100_000
"""Of one expression; more is a typing mistake."""

_DIGITS = 12
"""Significant digits of computed floats, so that steps of 0.1 read 0.3 and not 0.30000000000000004."""

_NUMBER = r"[-+]?(?:\d{1,40}\.?\d{0,40}|\.\d{1,40})(?:[eE][-+]?\d{1,3})?"
"""Longer ones are text. As exact fractions they would take gigabytes, and no parameter needs them."""
_INTEGER = re.compile(r"[-+]?\d{1,40}", re.ASCII)
_FLOAT = re.compile(_NUMBER, re.ASCII)
_DOTS = re.compile(rf"\s*{_NUMBER}\s*\.\.+\s*{_NUMBER}\s*", re.ASCII)
_RANGE = re.compile(rf"\s*({_NUMBER})\s*:\s*({_NUMBER})\s*(?::\s*({_NUMBER})\s*)?", re.ASCII)
_CALL = re.compile(r"\s*([A-Za-z]\w*)\s*\((.*)\)\s*")
_LARGEST_END, _SMALLEST_END = 1e100, 1e-100
"""Limits of the ends of a range, between which nothing can overflow or vanish."""
_WORDS: dict[str, Scalar] = {"true": True, "false": False}


class Computed(float):
    """A value computed by ``lin`` or ``log``; an integer parameter takes the nearest integer."""


def parse_values(raw: object) -> tuple[Value, ...]:
    """All values of ``raw``, in order.

    A list is taken literally: each element is one value, an element that is a list is a matrix. Text is an
    expression; parts between ``|`` may be ranges (the end included), ``lin(first, last, n)`` and
    ``log(first, last, n)``. Anything else is a single value.

    Raises:
        InvalidInput: for an empty combination, a value that appears twice, or an expression that makes no sense.
    """
    if isinstance(raw, list | tuple):
        values = [_literal(item) for item in raw]
    elif isinstance(raw, str):
        values = [value for part in raw.split("|") for value in _part(part, raw)]
    else:
        values = [_literal(raw)]
    if not values:
        raise InvalidInput(f"{raw!r} holds no value", "give at least one")
    if len(values) > MAX_VALUES:
        raise InvalidInput(f"{raw!r} gives {len(values):,} values, at most {MAX_VALUES:,} are allowed")
    return tuple(values)


def as_scalar(text: str) -> Scalar:
    """``text`` as an int, float or bool if it reads like one, itself otherwise."""
    text = text.strip()
    if _INTEGER.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text) and math.isfinite(float(text)):
        return float(text)
    return _WORDS.get(text.lower(), text)


def plain(value: Value) -> Value:
    """``value`` as one of the types that a configuration may hold."""
    return float(value) if isinstance(value, Computed) else value


def typed(parameter: Parameter, value: Value) -> Value:
    """``value`` with the type of ``parameter``; raises InvalidInput if it does not fit."""
    if isinstance(value, Computed) and parameter.type is ParameterType.INT:
        return parameter.parse(round(value))
    return parameter.parse(plain(value))


def rounded(value: float | Fraction) -> float:
    """``value`` with 12 significant digits."""
    return float(f"{float(value):.{_DIGITS}g}")


def check_distinct(values: Iterable[Value]) -> None:
    """Raise InvalidInput if a value is repeated: it would add the same runs again."""
    seen: set[tuple[str, Value]] = set()
    for value in values:
        if (type(value).__name__, value) in seen:
            raise InvalidInput(f"the value {value!r} is given twice")
        seen.add((type(value).__name__, value))


def _literal(item: object) -> Value:
    if isinstance(item, bool | int | float | str):
        if isinstance(item, float) and not math.isfinite(item):
            raise InvalidInput(f"{item!r} is not a finite number")
        return item
    if isinstance(item, list | tuple) and item and all(_is_number(entry) for entry in item):
        return tuple(float(entry) for entry in item)
    raise InvalidInput(f"{item!r} is not a value", "use a number, text, true, false or a list of numbers (a matrix)")


def _is_number(entry: object) -> bool:
    return isinstance(entry, int | float) and not isinstance(entry, bool)


def _part(part: str, whole: str) -> list[Scalar]:
    if not part.strip():
        raise InvalidInput(f"{whole!r} holds an empty value", "give at least one value on each side of '|'")
    if match := _RANGE.fullmatch(part):
        return _range(part.strip(), match[1], match[2], match[3] or "1")
    if _DOTS.fullmatch(part):
        raise InvalidInput(f"{part.strip()} is no finite choice", "write first:last:step, or lin(first, last, n)")
    if match := _CALL.fullmatch(part):
        return _call(part.strip(), match[1], match[2])
    return [as_scalar(part)]


def _range(text: str, first: str, last: str, step: str) -> list[Scalar]:
    start, stop, stride = _end(text, first), _end(text, last), Fraction(step)
    if stride == 0 or (stop - start) / stride < 0:
        raise InvalidInput(f"the range {text} never ends", "write first:last:step with a step that leads to the last")
    count = (stop - start) // stride + 1
    _check_count(text, count)
    whole = all(_INTEGER.fullmatch(part) for part in (first, last, step))
    numerators, denominator = _progression(start, stride, count)
    return [number // denominator if whole else rounded(number / denominator) for number in numerators]


def _call(text: str, name: str, arguments: str) -> list[Scalar]:
    parts = [part.strip() for part in arguments.split(",")]
    well_formed = len(parts) == 3 and all(_FLOAT.fullmatch(part) for part in parts) and _INTEGER.fullmatch(parts[2])
    if name not in {"lin", "log"} or not well_formed:
        raise InvalidInput(f"{text} is not understood", "use lin(first, last, n) or log(first, last, n)")
    count = int(parts[2])
    if count < 2:
        raise InvalidInput(f"{text} gives {count} values", "n is 2 or more")
    _check_count(text, count)
    first, last = _end(text, parts[0]), _end(text, parts[1])
    if name == "lin":
        numerators, denominator = _progression(first, (last - first) / (count - 1), count)
        whole = all(number % denominator == 0 for number in numerators)
        return [number // denominator if whole else Computed(rounded(number / denominator)) for number in numerators]
    if first <= 0 or last <= 0:
        raise InvalidInput(f"{text}: a logarithm needs ends above 0")
    ratio = math.log(float(last) / float(first))
    numbers = [rounded(float(first) * math.exp(ratio * index / (count - 1))) for index in range(count)]
    numbers[0], numbers[-1] = float(first), float(last)
    whole = all(number.is_integer() for number in numbers)
    return [int(number) if whole else Computed(number) for number in numbers]


def _end(text: str, number: str) -> Fraction:
    """The exact value of an end of the range ``text``."""
    end = Fraction(number)
    if end and not _SMALLEST_END <= abs(end) <= _LARGEST_END:
        raise InvalidInput(f"{text}: {number} is beyond what a range can reach", "use numbers between 1e-100 and 1e100")
    return end


def _progression(first: Fraction, step: Fraction, count: int) -> tuple[list[int], int]:
    """``first + index * step`` as exact numerators over one denominator: a Fraction for each would take seconds."""
    denominator = math.lcm(first.denominator, step.denominator)
    start, stride = int(first * denominator), int(step * denominator)
    return [start + index * stride for index in range(count)], denominator


def _check_count(text: str, count: int) -> None:
    if count > MAX_VALUES:
        raise InvalidInput(f"{text} gives {count:,} values, at most {MAX_VALUES:,} are allowed")
