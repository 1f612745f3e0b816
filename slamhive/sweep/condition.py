"""Conditions on combinations: ``image_rate >= 2 and not (algorithm == kiss-icp or dataset == room)``.

A small language of its own, parsed here; nothing is ever handed to Python's evaluation. Comparisons (``==``, ``!=``,
``<``, ``<=``, ``>``, ``>=``) join a name and a name or value, ``in`` a name and a list (``dataset in [room, MH_01]``);
``and``, ``or``, ``not`` and brackets combine them. Text may stand in quotes, and must if an axis has that name.

A name that has no meaning for a combination (a parameter that its algorithm does not have) makes the comparison
undecided; undecided parts follow Kleene's three-valued logic, and an undecided condition keeps the combination.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from slamhive.domain.parameters import Value
from slamhive.errors import InvalidInput
from slamhive.sweep.values import as_scalar

MAX_LENGTH = 2000
MAX_DEPTH = 50

Context = Mapping[str, Value]
Verdict = bool | None

_TOKEN = re.compile(
    r"""\s*(?:(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.-]))
    |(?P<word>[A-Za-z_][\w.-]*|[0-9][\w.-]*)|(?P<text>"[^"]*"|'[^']*')
    |(?P<sign><=|>=|==|!=|<|>|\(|\)|\[|\]|,))""",
    re.VERBOSE,
)
_COMPARISONS: dict[str, Callable[[Value, Value], bool]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}


@dataclass(frozen=True, slots=True)
class Name:
    """A word outside quotes: an axis or parameter if there is one of this name, text otherwise."""

    word: str


Operand = Name | Value


@dataclass(frozen=True, slots=True)
class Comparison:
    """``left sign right``; for ``in``, ``right`` holds several operands."""

    sign: str
    left: Name
    right: tuple[Operand, ...]

    def decide(self, context: Context, known: frozenset[str]) -> Verdict:
        """True, False, or None if a name has no value in ``context``."""
        left = context.get(self.left.word)
        if left is None:
            return None
        verdicts: list[Verdict] = []
        for entry in self.right:
            right = _value(entry, context, known)
            verdicts.append(None if right is None else _compare(self.sign, left, right))
        return _any(verdicts)


@dataclass(frozen=True, slots=True)
class Junction:
    """``and``, ``or`` over several conditions, ``not`` over one."""

    word: str
    parts: tuple[Condition, ...]

    def decide(self, context: Context, known: frozenset[str]) -> Verdict:
        """Kleene's logic: undecided unless the decided parts suffice."""
        verdicts = [part.decide(context, known) for part in self.parts]
        if self.word == "not":
            return None if verdicts[0] is None else not verdicts[0]
        if self.word == "or":
            return _any(verdicts)
        negated = _any([None if verdict is None else not verdict for verdict in verdicts])
        return None if negated is None else not negated


Condition = Comparison | Junction


def parse_condition(text: str) -> Condition:
    """The condition that ``text`` states; raises InvalidInput naming the part that is not understood."""
    if len(text) > MAX_LENGTH:
        raise InvalidInput(f"the condition has {len(text)} characters, at most {MAX_LENGTH} are allowed")
    return _Parser(text).parse()


def compared_names(condition: Condition) -> frozenset[str]:
    """The words on the left of comparisons: each must be the name of an axis or parameter."""
    if isinstance(condition, Comparison):
        return frozenset({condition.left.word})
    return frozenset().union(*(compared_names(part) for part in condition.parts))


def _value(operand: Operand, context: Context, known: frozenset[str]) -> Value | None:
    """What an operand stands for; None for a name that has no value in ``context``."""
    if not isinstance(operand, Name):
        return operand
    return context.get(operand.word) if operand.word in known else as_scalar(operand.word)


def _any(verdicts: list[Verdict]) -> Verdict:
    if True in verdicts:
        return True
    return None if None in verdicts else False


def _compare(sign: str, left: Value, right: Value) -> bool:
    if sign == "in":
        sign = "=="
    if isinstance(left, str) != isinstance(right, str):
        if sign not in {"==", "!="}:
            raise InvalidInput(f"{left!r} {sign} {right!r} compares text with a number")
        left, right = str(left), str(right)
    if isinstance(left, tuple) != isinstance(right, tuple):
        raise InvalidInput(f"{left!r} {sign} {right!r} compares a matrix with a plain value")
    return _COMPARISONS[sign](left, right)


class _Parser:
    """Recursive descent: or < and < not < comparison."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens = self._split(text)
        self._position = 0
        self._depth = 0

    def parse(self) -> Condition:
        condition = self._or()
        if self._position < len(self._tokens):
            raise self._refusal("'and', 'or' or the end")
        return condition

    def _split(self, text: str) -> list[tuple[str, str]]:
        tokens: list[tuple[str, str]] = []
        position = 0
        stripped = text.rstrip()
        while position < len(stripped):
            match = _TOKEN.match(stripped, position)
            if match is None:
                raise InvalidInput(f"the condition {text!r} is not understood at {stripped[position:].strip()[:20]!r}")
            assert match.lastgroup is not None
            tokens.append((match.lastgroup, match[match.lastgroup]))
            position = match.end()
        return tokens

    def _peek(self) -> tuple[str, str]:
        return self._tokens[self._position] if self._position < len(self._tokens) else ("end", "")

    def _take(self, *signs: str) -> bool:
        kind, token = self._peek()
        if kind in {"sign", "word"} and token in signs:
            self._position += 1
            return True
        return False

    def _refusal(self, expected: str) -> InvalidInput:
        kind, token = self._peek()
        found = "its end" if kind == "end" else repr(token)
        return InvalidInput(
            f"the condition {self._text!r} has {found} where {expected} belongs",
            "write comparisons such as image_rate >= 2, joined by and, or, not",
        )

    def _or(self) -> Condition:
        return self._joined("or", self._and)

    def _and(self) -> Condition:
        return self._joined("and", self._not)

    def _joined(self, word: str, inner: Callable[[], Condition]) -> Condition:
        parts = [inner()]
        while self._take(word):
            parts.append(inner())
        return parts[0] if len(parts) == 1 else Junction(word, tuple(parts))

    def _not(self) -> Condition:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise InvalidInput(f"the condition is nested deeper than {MAX_DEPTH} levels")
        try:
            if self._take("not"):
                return Junction("not", (self._not(),))
            if self._take("("):
                condition = self._or()
                if not self._take(")"):
                    raise self._refusal("')'")
                return condition
            return self._comparison()
        finally:
            self._depth -= 1

    def _comparison(self) -> Condition:
        left = self._operand()
        if not isinstance(left, Name):
            self._position -= 1
            raise self._refusal("a name")
        if self._take("in"):
            return Comparison("in", left, self._list())
        _, sign = self._peek()
        if sign not in _COMPARISONS:
            raise self._refusal("a comparison")
        self._position += 1
        return Comparison(sign, left, (self._operand(),))

    def _list(self) -> tuple[Operand, ...]:
        if not self._take("["):
            raise self._refusal("'['")
        entries = [self._operand()]
        while self._take(","):
            entries.append(self._operand())
        if not self._take("]"):
            raise self._refusal("']'")
        return tuple(entries)

    def _operand(self) -> Operand:
        kind, token = self._peek()
        if kind not in {"number", "word", "text"} or (kind == "word" and token in {"and", "or", "not", "in"}):
            raise self._refusal("a name or a value")
        self._position += 1
        if kind == "text":
            return token[1:-1]
        if kind == "number":
            return as_scalar(token)
        return token.lower() == "true" if token.lower() in {"true", "false"} else Name(token)
