"""Filters before their names and values are looked up, and how they are written."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Generic, NamedTuple, TypeAlias, TypeVar

from slamhive.base.errors import InvalidInput
from slamhive.filters.fields import UNITS, is_number

# Splits filters into tokens, and points at mistakes. Conditions of experiments use it too.


_TOKEN = re.compile(
    r"""\s*(?:(?P<text>"[^"]*(?:""[^"]*)*"|'[^']*(?:''[^']*)*')
    |(?P<sign>=>|=<|<=|>=|==|!=|!~|[<>=~(),\[\]])
    |(?P<word>[^\s"'<>=~!(),\[\]]+))""",
    re.VERBOSE,
)
_SHOWN = 60
KEYWORDS = frozenset({"and", "or", "not", "in", "between"})
"""Words that need quotes to be a name or a value."""


class FilterPlace(NamedTuple):
    """A place in a text: the first character and the one after the last, from 0."""

    start: int
    end: int


NOWHERE = FilterPlace(0, 0)
"""The place of something that was not read from a text."""


@dataclass(frozen=True, slots=True)
class FilterToken:
    """A ``word``, a quoted ``text`` (its quotes removed), a ``sign``, or the ``end``."""

    kind: str
    text: str
    place: FilterPlace


class FilterError(InvalidInput):
    """A mistake in a filter. The message is one line; :attr:`pointer` marks the place below the text.

    Args:
        message: What is wrong.
        remedy: What to do.
        source: The whole text.
        place: The part of it that is meant.
    """

    def __init__(self, message: str, remedy: str | None, source: str, place: FilterPlace) -> None:
        self.source = source
        self.place = place
        super().__init__(f"{message} (at character {place.start + 1})", remedy)

    @property
    def pointer(self) -> tuple[str, str]:
        """The line of text around the place, and a line with carets below it."""
        begin = max(0, self.place.start - _SHOWN // 2)
        shown = "".join(c if c.isprintable() else " " for c in self.source[begin : begin + 2 * _SHOWN])
        width = max(1, min(self.place.end, begin + len(shown)) - self.place.start)
        lead = "… " if begin else ""
        return lead + shown, " " * (len(lead) + self.place.start - begin) + "^" * width


def split(text: str) -> tuple[list[FilterToken], FilterPlace | None]:
    """The tokens of ``text``, and the place of the first character that begins none, if there is one."""
    tokens: list[FilterToken] = []
    position = 0
    while (match := _TOKEN.match(text, position)) is not None:
        kind = str(match.lastgroup)
        found = match[kind]
        place = FilterPlace(match.start(kind), match.end(kind))
        tokens.append(
            FilterToken(kind, found[1:-1].replace(found[0] * 2, found[0]) if kind == "text" else found, place)
        )
        position = match.end()
    rest = len(text) - len(text[position:].lstrip())
    tokens.append(FilterToken("end", "", FilterPlace(len(text), len(text))))
    return tokens, FilterPlace(rest, rest + 1) if rest < len(text) else None


def quoted(text: str) -> str:
    """``text`` in quotes if it needs them to be read as one word."""
    match = _TOKEN.fullmatch(text)
    if match is not None and match.lastgroup == "word" and text.lower() not in KEYWORDS and text == text.strip():
        return text
    return '"' + text.replace('"', '""') + '"'


def shortened(text: str) -> str:
    """``text`` as a message shows it."""
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "…"


# ``and``, ``or``, ``not`` and brackets over comparisons of any kind.


Leaf = TypeVar("Leaf")
Other = TypeVar("Other")


@dataclass(frozen=True, slots=True)
class Junction(Generic[Leaf]):
    """``and``, ``or`` over two or more parts, ``not`` over one. Parts of the same word are joined, not nested."""

    word: str
    parts: tuple[Junction[Leaf] | Leaf, ...]


Tree: TypeAlias = Junction[Leaf] | Leaf


def join(word: str, parts: list[Tree[Leaf]]) -> Tree[Leaf]:
    """Join parts by ``and`` or ``or``; a single part stays alone."""
    flat: list[Tree[Leaf]] = []
    for part in parts:
        flat.extend(part.parts if isinstance(part, Junction) and part.word == word else [part])
    return flat[0] if len(flat) == 1 else Junction(word, tuple(flat))


def all_of(parts: Iterable[Tree[Leaf] | None]) -> Tree[Leaf] | None:
    """Join the parts that there are by ``and``; None without any."""
    there = [part for part in parts if part is not None]
    return join("and", there) if there else None


def leaves(tree: Tree[Leaf]) -> Iterator[Leaf]:
    """Every comparison, from left to right."""
    if isinstance(tree, Junction):
        for part in tree.parts:
            yield from leaves(part)
    else:
        yield tree


def mapped(tree: Tree[Leaf], change: Callable[[Leaf], Other]) -> Tree[Other]:
    """The same tree with each comparison replaced by ``change`` of it."""
    if isinstance(tree, Junction):
        return Junction(tree.word, tuple(mapped(part, change) for part in tree.parts))
    return change(tree)


def written(tree: Tree[Leaf], leaf: Callable[[Leaf], str], outer: str = "") -> str:
    """The tree as text, with brackets where they are needed."""
    if not isinstance(tree, Junction):
        return leaf(tree)
    if tree.word == "not":
        (part,) = tree.parts
        inner = written(part, leaf, "not")
        return f"not ({inner})" if isinstance(part, Junction) else f"not {inner}"
    text = f" {tree.word} ".join(written(part, leaf, tree.word) for part in tree.parts)
    return f"({text})" if tree.word == "or" and outer == "and" else text


class Sign(StrEnum):
    """Kind of comparison of a name."""

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
    place: FilterPlace = field(default=NOWHERE, compare=False)
    quoted: bool = field(default=False, compare=False)


ATTRIBUTE = "attribute"
"""The name that a word alone is compared with: ``indoor`` means ``attribute = indoor``."""


@dataclass(frozen=True, slots=True)
class FilterComparison:
    """``name sign values``: one value, two for ``between``, any number for ``in``, none for ``has`` and ``missing``."""

    name: Word
    sign: Sign
    values: tuple[Word, ...] = ()
    place: FilterPlace = field(default=NOWHERE, compare=False)

    @property
    def is_alone(self) -> bool:
        """Tell if only the value was written."""
        return self.place != NOWHERE and self.name.place == self.place


Filter: TypeAlias = Tree[FilterComparison]


def reversed_range(leaf: FilterComparison, source: str) -> FilterError:
    """The error for a ``between`` whose first value is larger; ``source`` is the whole text."""
    low, high = (_value_text(value.text) for value in leaf.values)
    remedy = f"write {quoted(leaf.name.text)} between {high} and {low}"
    return FilterError(f"nothing lies between {low} and {high}", remedy, source, leaf.place)


def experiment_filter(name: str) -> str:
    """The filter of the runs of an experiment, whose name may be a word of the language, such as ``not``."""
    return filter_text(FilterComparison(Word("experiment"), Sign.EQUAL, (Word(name),)))


def filter_text(tree: Filter | None) -> str:
    """The filter in its canonical spelling; parsing it gives ``tree`` again."""
    return "" if tree is None else written(tree, _comparison_text)


def _comparison_text(leaf: FilterComparison) -> str:
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
