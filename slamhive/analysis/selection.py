"""Which runs an analysis is about: named sets, and an expression over them (union, intersection, difference)."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import dataclass

from slamhive.errors import InvalidInput, unknown

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
    """``(a | b) - c``; operators are taken from left to right, with no precedence: parentheses say what is meant.

    ``union``, ``intersection`` and ``minus`` (or the signs of mathematics) may be written instead.

    Raises:
        InvalidInput: pointing at the place.
    """
    parser = _Parser(text)
    expression = parser.expression(0)
    parser.end()
    return expression


def names_in(expression: Expression) -> set[str]:
    """The sets that an expression names."""
    if isinstance(expression, SetName):
        return {expression.name}
    return names_in(expression.left) | names_in(expression.right)


def union_of(names: Collection[str]) -> Expression:
    """Everything that is in any of the sets."""
    first, *others = [SetName(name) for name in names]
    expression: Expression = first
    for other in others:
        expression = Combined("|", expression, other)
    return expression


def evaluate(expression: Expression, members: Callable[[str], frozenset[int]]) -> frozenset[int]:
    """The run ids that ``expression`` means.

    Args:
        expression: Over names of sets.
        members: The run ids of the set of a name; raises NotFound for one that does not exist.
    """
    if isinstance(expression, SetName):
        return members(expression.name)
    return _MEANING[expression.sign](evaluate(expression.left, members), evaluate(expression.right, members))


def in_words(expression: Expression, words: Callable[[str], str]) -> str:
    """The expression as a sentence; ``words`` says what the set of a name is."""
    if isinstance(expression, SetName):
        return words(expression.name)
    left, right = in_words(expression.left, words), in_words(expression.right, words)
    return f"({left}) {_IN_WORDS[expression.sign]} ({right})"


def check_names(expression: Expression, known: Collection[str]) -> None:
    """Raise NotFound for a name that is no set."""
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
            raise self._error(len(self._text), "a set's name is missing")
        kind, value, at = token
        self._next += 1
        if kind == "name":
            return SetName(value)
        if value != "(":
            raise self._error(at, f"expected a set's name, found {value!r}")
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
        return InvalidInput(f"'use' at character {at + 1}: {what} in {shown!r}", "write for example (a | b) - c")
