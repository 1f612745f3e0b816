"""The runs of an analysis: an expression over named sets (union, intersection, difference)."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import dataclass

from slamhive.base.errors import InvalidInput, unknown

_TOKEN = re.compile(r"\s*(?:(?P<name>[A-Za-z_][A-Za-z0-9_]*)|(?P<sign>[|&()∪∩∖\\-]))")
_WORDS = {"union": "|", "or": "|", "intersection": "&", "and": "&", "minus": "-", "without": "-", "difference": "-"}
_SIGNS = {"∪": "|", "∩": "&", "∖": "-", "\\": "-"}
_MEANING: dict[str, Callable[[frozenset[int], frozenset[int]], frozenset[int]]] = {
    "|": frozenset.union,
    "&": frozenset.intersection,
    "-": frozenset.difference,
}
_IN_WORDS = {"|": "or", "&": "and also", "-": "but not"}
_MAX_DEPTH = 50


@dataclass(frozen=True, slots=True)
class SetName:
    """A set by its name."""

    name: str


@dataclass(frozen=True, slots=True)
class Combined:
    """Two expressions joined by ``|`` (union), ``&`` (intersection) or ``-`` (difference)."""

    sign: str
    left: Expression
    right: Expression


Expression = SetName | Combined


def parse_expression(text: str) -> Expression:
    """Parse an expression such as ``(a | b) - c``.

    Operators have equal precedence and apply from left to right. Words (``union``, ``intersection``, ``minus``) and
    mathematical signs are allowed too.

    Raises:
        InvalidInput: with the position of the mistake.
    """
    parser = _Parser(text)
    expression = parser.expression(0)
    parser.end()
    return expression


def names_in(expression: Expression) -> set[str]:
    """The names of the sets in an expression."""
    if isinstance(expression, SetName):
        return {expression.name}
    return names_in(expression.left) | names_in(expression.right)


def union_of(names: Collection[str]) -> Expression:
    """The union of all sets."""
    first, *others = [SetName(name) for name in names]
    expression: Expression = first
    for other in others:
        expression = Combined("|", expression, other)
    return expression


def evaluate(expression: Expression, members: Callable[[str], frozenset[int]]) -> frozenset[int]:
    """The run ids in the set that ``expression`` describes.

    Args:
        expression: Over names of sets.
        members: Gives the run ids of a set by its name; raises NotFound for an unknown name.
    """
    if isinstance(expression, SetName):
        return members(expression.name)
    return _MEANING[expression.sign](evaluate(expression.left, members), evaluate(expression.right, members))


def in_words(expression: Expression, words: Callable[[str], str]) -> str:
    """The expression in words; ``words`` describes a set by its name."""
    if isinstance(expression, SetName):
        return words(expression.name)
    left, right = in_words(expression.left, words), in_words(expression.right, words)
    return f"({left}) {_IN_WORDS[expression.sign]} ({right})"


def check_names(expression: Expression, known: Collection[str]) -> None:
    """Raise NotFound for a name without a set."""
    for name in sorted(names_in(expression)):
        if name not in known:
            raise unknown("set", name, list(known))


class _Parser:
    def __init__(self, text: str) -> None:
        self._text = text
        self._place = 0
        self._tokens: list[tuple[str, str, int]] = []
        while text[self._place :].strip():
            match = _TOKEN.match(text, self._place)
            if match is None:
                at = self._place + len(text[self._place :]) - len(text[self._place :].lstrip())
                raise self._error(at, f"unexpected {text[at]!r}")
            kind, token = ("name", match["name"]) if match["name"] else ("sign", match["sign"])
            if kind == "name" and token.lower() in _WORDS:
                kind, token = "sign", _WORDS[token.lower()]
            self._tokens.append((kind, _SIGNS.get(token, token), match.end() - len(match[0].strip())))
            self._place = match.end()
        self._next = 0

    def expression(self, depth: int) -> Expression:
        if depth > _MAX_DEPTH:
            raise InvalidInput(f"'use' is nested deeper than {_MAX_DEPTH} parentheses")
        left = self._operand(depth)
        while (token := self._peek()) is not None and token[1] in _MEANING:
            self._next += 1
            left = Combined(token[1], left, self._operand(depth))
        return left

    def end(self) -> None:
        token = self._peek()
        if token is not None:
            raise self._error(token[2], f"unexpected {token[1]!r}")

    def _operand(self, depth: int) -> Expression:
        token = self._peek()
        if token is None:
            raise self._error(len(self._text), "the name of a set is missing")
        kind, value, at = token
        self._next += 1
        if kind == "name":
            return SetName(value)
        if value != "(":
            raise self._error(at, f"expected the name of a set, found {value!r}")
        inner = self.expression(depth + 1)
        closing = self._peek()
        if closing is None or closing[1] != ")":
            raise self._error(at, "this '(' is not closed")
        self._next += 1
        return inner

    def _peek(self) -> tuple[str, str, int] | None:
        return self._tokens[self._next] if self._next < len(self._tokens) else None

    def _error(self, at: int, what: str) -> InvalidInput:
        shown = self._text if len(self._text) <= 80 else f"{self._text[:77]}..."
        return InvalidInput(f"'use' at character {at + 1}: {what} in {shown!r}", "an example: (a | b) - c")
