"""The limits of all input: text, numbers, depth and length of requests, files and commands.

Text can be encoded and holds no control characters. Numbers are finite and fit 64 bits. Nothing is nested deeply.
All input is read through this module, so the code behind relies on these limits. It needs only the standard library,
because algorithm images install it with :mod:`slamhive.runtime`.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any, NoReturn

from slamhive.base.errors import CONTROL_CHARACTERS, SURROGATES, InvalidInput

LARGEST_INTEGER = 2**64
DEEPEST_JSON = 32
MOST_RECORD_BYTES = 64_000_000
"""The largest JSON file that SLAM Hive writes itself."""
_MOST_DIGITS = 20
_SHOWN = 40
_NOT_TYPED = re.compile(f"[{CONTROL_CHARACTERS}{SURROGATES}]")
_NOT_RECORDED = re.compile(f"[{SURROGATES}]")


def check_text(text: str, place: str, *, recorded: bool = False) -> str:
    """Return ``text``; raise InvalidInput that names ``place`` and the character if it holds one that is not allowed.

    ``recorded`` text comes from a program, for example from the log of an algorithm: it may hold control characters,
    and still has to be text that can be encoded.
    """
    problem = _text_problem(text, _NOT_RECORDED if recorded else _NOT_TYPED)
    if problem is not None:
        raise InvalidInput(f"{place} {problem}", "remove the character")
    return text


def check_value(value: object, place: str, *, recorded: bool = False, deepest: int = DEEPEST_JSON) -> None:
    """Raise InvalidInput if a text, number or level anywhere in ``value`` exceeds the limits.

    Args:
        value: What a parser made of the input: dict, list, text, numbers, None.
        place: What messages call it; the path inside is added to it.
        recorded: As for :func:`check_text`.
        deepest: How many dicts and lists may lie within each other.
    """
    found = find_problem(value, recorded=recorded, deepest=deepest)
    if found is not None:
        path, problem = found
        raise InvalidInput(": ".join([place, *([".".join(path)] if path else []), problem]))


def find_problem(
    value: object, *, recorded: bool = False, deepest: int = DEEPEST_JSON
) -> tuple[tuple[str, ...], str] | None:
    """The path and description of the first problem in ``value``, or None; see :func:`check_value`."""
    return _problem(value, _NOT_RECORDED if recorded else _NOT_TYPED, deepest)


def decode(data: bytes, source: str) -> str:
    """``data`` as UTF-8 text; a byte order mark at its beginning is dropped. Raises InvalidInput."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InvalidInput(f"{source} line {line} is not UTF-8 text", "save the file as UTF-8") from None


def read_text(path: Path, most_bytes: int) -> str:
    """The text of the file at ``path``; raises InvalidInput, also for more than ``most_bytes`` (never read)."""
    try:
        with path.open("rb") as stream:
            data = stream.read(most_bytes + 1)
    except FileNotFoundError:
        raise InvalidInput(f"{path} does not exist") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InvalidInput(f"{path} cannot be read: {reason}") from None
    if len(data) > most_bytes:
        raise too_large(str(path), most_bytes)
    return decode(data, str(path))


def too_large(source: str, most_bytes: int) -> InvalidInput:
    """The error for input that is too large."""
    return InvalidInput(f"{source} is larger than {most_bytes} bytes", "is it the right file?")


def parse_json(data: str | bytes, source: str, *, recorded: bool = False, deepest: int = DEEPEST_JSON) -> Any:
    """Parse a JSON value; raises InvalidInput that names the place of a mistake or of an exceeded limit."""
    text = decode(data, source) if isinstance(data, bytes) else data
    try:
        value = json.loads(text, parse_constant=_refuse_constant, parse_float=_finite, parse_int=_integer)
    except RecursionError:
        raise InvalidInput(f"{source} is nested deeper than {deepest} levels") from None
    except ValueError as error:
        raise InvalidInput(f"{source} is not JSON that can be used: {error}") from None
    check_value(value, source, recorded=recorded, deepest=deepest)
    return value


def parse_json_object(data: str | bytes, source: str, *, recorded: bool = False) -> dict[str, Any]:
    """Parse a JSON object; see :func:`parse_json`."""
    value = parse_json(data, source, recorded=recorded)
    if not isinstance(value, dict):
        raise InvalidInput(f"{source} is not a JSON object", "it begins with { and ends with }")
    return value


def read_record(path: Path) -> dict[str, Any]:
    """Read a JSON object from a file that SLAM Hive has written; raises InvalidInput."""
    return parse_json_object(read_text(path, MOST_RECORD_BYTES), str(path), recorded=True)


def whole_number(text: str, name: str, minimum: int, maximum: int) -> int:
    """Parse a whole number; raises InvalidInput that names it and the bounds."""
    digits = text.strip()
    number = int(digits) if digits.isascii() and digits.isdigit() and len(digits) <= _MOST_DIGITS else None
    if number is None or not minimum <= number <= maximum:
        raise InvalidInput(f"{name} {text[:_SHOWN]!r} is not allowed", f"use {minimum} to {maximum}")
    return number


def _problem(value: object, not_text: re.Pattern[str], levels: int) -> tuple[tuple[str, ...], str] | None:
    if isinstance(value, dict | list):
        if levels == 0:
            return (), "is nested too deeply"
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            broken = _scalar_problem(key, not_text)
            found = _problem(item, not_text, levels - 1) if broken is None else ((), f"the key {broken}")
            if found is not None:
                path, problem = found
                return (_named(key), *path), problem
        return None
    broken = _scalar_problem(value, not_text)
    return None if broken is None else ((), broken)


def _scalar_problem(value: object, not_text: re.Pattern[str]) -> str | None:
    if isinstance(value, str):
        return _text_problem(value, not_text)
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value} is not a finite number"
    if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        return "is a whole number of more than 64 bits"
    return None


def _named(key: object) -> str:
    """A key as a part of a place."""
    if isinstance(key, int) and abs(key) > LARGEST_INTEGER:
        return "(a huge number)"
    return str(key)[:_SHOWN]


def _text_problem(text: str, not_text: re.Pattern[str]) -> str | None:
    found = not_text.search(text)
    if found is None:
        return None
    kind = "half of a surrogate pair" if re.match(f"[{SURROGATES}]", found[0]) else "a control character"
    return f"holds the character U+{ord(found[0]):04X}, {kind}, which is not text"


def _refuse_constant(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a finite number")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{_beginning(text)} is not a finite number")
    return value


def _integer(text: str) -> int:
    value = int(text) if len(text) <= _MOST_DIGITS + 1 else None
    if value is None or abs(value) > LARGEST_INTEGER:
        raise ValueError(f"{_beginning(text)} is a whole number of more than 64 bits")
    return value


def _beginning(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
