"""Keys in addresses that say where a page of a list ended, and the rows after it."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from datetime import datetime
from enum import StrEnum
from typing import Any

from sqlalchemy import ColumnElement, and_, or_

from slamhive.errors import InvalidInput
from slamhive.input_bounds import parse_json

_LARGEST: dict[type, float] = {int: 2.0**63, float: math.inf}


def encode(values: Sequence[Any]) -> str:
    """The key of a row: the values that the list is sorted by."""
    plain = [value.isoformat() if isinstance(value, datetime) else value for value in values]
    return base64.urlsafe_b64encode(json.dumps(plain).encode()).decode().rstrip("=")


def decode(key: str, kinds: Sequence[type]) -> list[Any]:
    """The values of a key; the first may be None. Raises InvalidInput for a key of another kind of list."""
    try:
        values = parse_json(base64.urlsafe_b64decode(key + "=" * (-len(key) % 4)), "the page key")
    except (ValueError, InvalidInput):
        raise not_ours(key) from None
    if not isinstance(values, list) or len(values) != len(kinds):
        raise not_ours(key)
    return [
        None if value is None and place == 0 and len(values) > 1 else _checked(value, kind, key)
        for place, (value, kind) in enumerate(zip(values, kinds, strict=True))
    ]


def behind(columns: Sequence[ColumnElement[Any]], values: Sequence[Any], *, descending: bool) -> ColumnElement[bool]:
    """The rows after the one with ``values``; NULLs of the first column are last in both directions."""
    first, rest = columns[0], columns[1:]
    if not rest:
        return _further(first, values[0], descending=descending)
    inner = behind(rest, values[1:], descending=descending)
    if values[0] is None:
        return and_(first.is_(None), inner)
    return or_(_further(first, values[0], descending=descending), and_(first == values[0], inner), first.is_(None))


def ordered(columns: Sequence[ColumnElement[Any]], *, descending: bool) -> list[ColumnElement[Any]]:
    """The order of ``columns`` in one direction."""
    return [column.desc() if descending else column.asc() for column in columns]


def not_ours(key: str) -> InvalidInput:
    """The refusal of a key."""
    return InvalidInput(f"page key {key[:60]!r} is not one of ours", "start at the first page")


def _further(column: ColumnElement[Any], value: Any, *, descending: bool) -> ColumnElement[bool]:
    found: ColumnElement[bool] = column < value if descending else column > value
    return found


def _checked(value: Any, kind: type, key: str) -> Any:
    if kind is datetime and isinstance(value, str):
        try:
            return datetime.fromisoformat(value)
        except ValueError:
            raise not_ours(key) from None
    if issubclass(kind, StrEnum) and value in list(kind):
        return kind(value)
    number = type(value) in {int, float} and math.isfinite(value) and abs(value) < _LARGEST[kind]
    if not (number if kind in _LARGEST else type(value) is kind) or (kind is int and type(value) is not int):
        raise not_ours(key)
    return value
