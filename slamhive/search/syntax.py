"""Filters before their names and values are looked up, and how they are written."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TypeAlias

from slamhive.search.grammar import Tree, written
from slamhive.search.reader import NOWHERE, FilterError, Place, quoted
from slamhive.search.units import UNITS, is_number


class Sign(StrEnum):
    """How a name is compared."""

    EQUAL = "="
    NOT_EQUAL = "!="
    LESS = "<"
    AT_MOST = "<="
    MORE = ">"
    AT_LEAST = ">="
    LIKE = "~"
    UNLIKE = "!~"
    IN = "in"
    NOT_IN = "not in"
    BETWEEN = "between"
    HAS = "has"
    MISSING = "missing"


PRESENCE = (Sign.HAS, Sign.MISSING)
SIGNS = {
    **{sign.value: sign for sign in Sign if not sign.value[0].isalpha()},
    "==": Sign.EQUAL,
    "=>": Sign.AT_LEAST,
    "=<": Sign.AT_MOST,
}
"""All spellings of signs that are not words."""


@dataclass(frozen=True, slots=True)
class Word:
    """A name or a value, its place, and whether it was quoted."""

    text: str
    place: Place = field(default=NOWHERE, compare=False)
    quoted: bool = field(default=False, compare=False)


ATTRIBUTE = "attribute"
"""The name that a word alone is compared with: ``indoor`` means ``attribute = indoor``."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """``name sign values``: one value, two for ``between``, any number for ``in``, none for ``has`` and ``missing``."""

    name: Word
    sign: Sign
    values: tuple[Word, ...] = ()
    place: Place = field(default=NOWHERE, compare=False)

    @property
    def is_alone(self) -> bool:
        """Whether only the value was written."""
        return self.place != NOWHERE and self.name.place == self.place


Filter: TypeAlias = Tree[Comparison]


def reversed_range(leaf: Comparison, source: str) -> FilterError:
    """The error for a ``between`` whose first value is larger; ``source`` is the whole text."""
    low, high = (_value_text(value.text) for value in leaf.values)
    remedy = f"write {quoted(leaf.name.text)} between {high} and {low}"
    return FilterError(f"nothing lies between {low} and {high}", remedy, source, leaf.place)


def filter_text(tree: Filter | None) -> str:
    """The filter in its canonical spelling; parsing it gives ``tree`` again."""
    return "" if tree is None else written(tree, _comparison_text)


def _comparison_text(leaf: Comparison) -> str:
    name, values = quoted(leaf.name.text), [_value_text(value.text) for value in leaf.values]
    if leaf.sign in PRESENCE:
        return f"{leaf.sign} {name}"
    if leaf.sign is Sign.BETWEEN:
        return f"{name} between {values[0]} and {values[1]}"
    if leaf.sign in {Sign.IN, Sign.NOT_IN}:
        return f"{name} {leaf.sign} ({', '.join(values)})"
    return f"{name} {leaf.sign} {values[0]}"


def _value_text(text: str) -> str:
    number, _, unit = text.partition(" ")
    return text if unit in UNITS and is_number(number) else quoted(text)
