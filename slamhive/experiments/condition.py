"""Conditions on combinations, in the language of filters: ``image_rate >= 2 and not dataset in (room, MH_01)``.

A word on the right that is the name of an axis or parameter means its value; text that must not be taken for one stands
in quotes. Numbers are plain: what unit an axis has is not known here.

A name may have no meaning for a combination: its algorithm does not have the parameter. The comparison is then
undecided. Undecided parts follow Kleene's three-valued logic, and an undecided condition keeps the combination.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from slamhive.base.errors import InvalidInput
from slamhive.domain.parameters import Value
from slamhive.experiments.values import as_scalar
from slamhive.filters.binding import matches
from slamhive.filters.fields import is_number
from slamhive.filters.parser import parse_filter
from slamhive.filters.syntax import PRESENCE, FilterError, Junction, Sign, Tree, Word, leaves, mapped, reversed_range
from slamhive.filters.syntax import FilterComparison as Written

MAX_LENGTH = 2000
EXAMPLE = "write comparisons such as image_rate >= 2, joined by and, or, not"

Context = Mapping[str, Value]
Verdict = bool | None

_COMPARE: dict[Sign, Callable[[Any, Any], bool]] = {
    Sign.EQUAL: operator.eq,
    Sign.IN: operator.eq,
    Sign.LESS: operator.lt,
    Sign.AT_MOST: operator.le,
    Sign.MORE: operator.gt,
    Sign.AT_LEAST: operator.ge,
}
_NEGATED = {Sign.NOT_EQUAL: Sign.EQUAL, Sign.UNLIKE: Sign.LIKE, Sign.NOT_IN: Sign.IN, Sign.MISSING: Sign.HAS}


@dataclass(frozen=True, slots=True)
class Name:
    """A word outside quotes: an axis or parameter if there is one of this name, else ``value``."""

    word: str
    value: Value


Operand = Name | str


@dataclass(frozen=True, slots=True)
class ConditionComparison:
    """``left sign right``."""

    left: str
    sign: Sign
    right: tuple[Operand, ...]

    def decide(self, context: Context, known: frozenset[str]) -> Verdict:
        """True, False, or None if a name has no value in ``context``; whether it has one is always decided."""
        left = context.get(self.left)
        if self.sign in PRESENCE:
            return (left is not None) is (self.sign is Sign.HAS)
        if left is None:
            return None
        right = [_value(operand, context, known) for operand in self.right]
        if self.sign in _NEGATED:
            return _not(_compare(_NEGATED[self.sign], left, right))
        return _compare(self.sign, left, right)


@dataclass(frozen=True, slots=True)
class CombinationCondition:
    """A condition on combinations."""

    tree: Tree[ConditionComparison]

    def decide(self, context: Context, known: frozenset[str]) -> Verdict:
        """Kleene's logic: undecided (None) unless the decided parts suffice. ``known``: every name with a meaning."""
        return _decide(self.tree, context, known)


def parse_condition(text: str) -> CombinationCondition:
    """The condition that ``text`` states; raises InvalidInput naming the part that is not understood."""
    title = f"condition {text if len(text) <= 80 else text[:80] + '…'!r}"
    tree = parse_filter(text, title, longest=MAX_LENGTH, alone=False)
    if tree is None:
        raise InvalidInput(
            "the condition is empty", "write comparisons such as image_rate >= 2, joined by and, or, not"
        )
    return CombinationCondition(mapped(tree, lambda leaf: _comparison(leaf, text)))


def compared_names(condition: CombinationCondition) -> frozenset[str]:
    """The words on the left of comparisons: each must be the name of an axis or parameter."""
    return frozenset(leaf.left for leaf in leaves(condition.tree))


def read_names(condition: CombinationCondition) -> frozenset[str]:
    """The words of comparisons that may be names, on both sides."""
    right = (operand.word for leaf in leaves(condition.tree) for operand in leaf.right if isinstance(operand, Name))
    return compared_names(condition).union(right)


def _comparison(leaf: Written, text: str) -> ConditionComparison:
    if not leaf.name.quoted and is_number(leaf.name.text):
        raise FilterError(
            f"{leaf.name.text!r} stands where a name belongs", "write the name first", text, leaf.name.place
        )
    right = tuple(_operand(word, text) for word in leaf.values)
    if leaf.sign is Sign.BETWEEN:
        low, high = (operand.value if isinstance(operand, Name) else None for operand in right)
        if isinstance(low, int | float) and isinstance(high, int | float) and low > high:
            raise reversed_range(leaf, text)
    return ConditionComparison(leaf.name.text, leaf.sign, right)


def _operand(word: Word, text: str) -> Operand:
    if word.quoted:
        return word.text
    if " " in word.text:
        raise FilterError(f"{word.text!r} has a unit", "write the number alone", text, word.place)
    return Name(word.text, as_scalar(word.text))


def _value(operand: Operand, context: Context, known: frozenset[str]) -> Value | None:
    """The value of an operand; None for a name without a value in ``context``."""
    if isinstance(operand, str):
        return operand
    return context.get(operand.word) if operand.word in known else operand.value


def _decide(tree: Tree[ConditionComparison], context: Context, known: frozenset[str]) -> Verdict:
    if not isinstance(tree, Junction):
        return tree.decide(context, known)
    verdicts = [_decide(part, context, known) for part in tree.parts]
    if tree.word == "not":
        return _not(verdicts[0])
    return _any(verdicts) if tree.word == "or" else _all(verdicts)


def _not(verdict: Verdict) -> Verdict:
    return None if verdict is None else not verdict


def _any(verdicts: Iterable[Verdict]) -> Verdict:
    found = list(verdicts)
    if True in found:
        return True
    return None if None in found else False


def _all(verdicts: Iterable[Verdict]) -> Verdict:
    return _not(_any(map(_not, verdicts)))


def _compare(sign: Sign, left: Value, right: list[Value | None]) -> Verdict:
    """Compare by a sign that is not the negation of another one."""
    if sign is Sign.BETWEEN:
        return _all([_one(Sign.AT_LEAST, left, right[0]), _one(Sign.AT_MOST, left, right[1])])
    return _any(_one(sign, left, value) for value in right)


def _one(sign: Sign, left: Value, right: Value | None) -> Verdict:
    if right is None:
        return None
    if sign is Sign.LIKE:
        return matches(str(left), str(right))
    if isinstance(left, str) != isinstance(right, str):
        if _COMPARE[sign] is not operator.eq:
            raise InvalidInput(f"{left!r} {sign} {right!r} compares text with a number")
        left, right = str(left), str(right)
    if isinstance(left, tuple) != isinstance(right, tuple):
        raise InvalidInput(f"{left!r} {sign} {right!r} compares a matrix with a plain value")
    return _COMPARE[sign](left, right)
