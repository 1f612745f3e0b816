"""What a filter says, before names and values have a meaning: ``parse_filter`` and its inverse ``filter_text``."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TypeAlias

from slamhive.search.grammar import Tree, leaves, read_tree, written
from slamhive.search.reader import KEYWORDS, NOWHERE, FilterError, Place, Reader, quoted
from slamhive.search.units import UNITS, is_number

MAX_LENGTH = 50_000
MAX_DEPTH = 50
MAX_TERMS = 200
MAX_VALUES = 500
EXAMPLE = "write comparisons such as ate.rmse < 0.1, joined by and, or, not"


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
_SIGNS = {
    **{sign.value: sign for sign in Sign if not sign.value[0].isalpha()},
    "==": Sign.EQUAL,
    "=>": Sign.AT_LEAST,
    "=<": Sign.AT_MOST,
}


@dataclass(frozen=True, slots=True)
class Word:
    """A name or a value, where it stands, and whether in quotes."""

    text: str
    place: Place = field(default=NOWHERE, compare=False)
    quoted: bool = field(default=False, compare=False)


@dataclass(frozen=True, slots=True)
class Comparison:
    """``name sign values``: one value, two for ``between``, any number for ``in``, none for ``has`` and ``missing``."""

    name: Word
    sign: Sign
    values: tuple[Word, ...] = ()
    place: Place = field(default=NOWHERE, compare=False)


Filter: TypeAlias = Tree[Comparison]


def parse_filter(text: str, title: str = "filter", example: str = EXAMPLE, longest: int = MAX_LENGTH) -> Filter | None:
    """The filter that ``text`` states, None for an empty one; raises FilterError pointing at what is not understood.

    ``title`` and ``example`` are for messages; ``longest``: most characters.
    """
    reader = Reader(text, title, example, longest=longest, deepest=MAX_DEPTH)
    if reader.peek().kind == "end":
        return None
    tree = read_tree(reader, _comparison)
    found = list(leaves(tree))
    if len(found) > MAX_TERMS:
        place = found[MAX_TERMS].place
        raise reader.refusal(f"the {title} has {len(found)} comparisons, at most {MAX_TERMS} are allowed", place)
    return tree


def reversed_range(leaf: Comparison, source: str) -> FilterError:
    """The refusal of a ``between`` whose first value is the larger; ``source`` is the whole text."""
    low, high = (_value_text(value.text) for value in leaf.values)
    remedy = f"write {quoted(leaf.name.text)} between {high} and {low}"
    return FilterError(f"nothing lies between {low} and {high}", remedy, source, leaf.place)


def filter_text(tree: Filter | None) -> str:
    """The filter in its one canonical spelling; parsing it gives ``tree`` again."""
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


def _comparison(reader: Reader) -> Comparison:
    start = reader.peek().place.start
    behind = reader.peek(1)
    if behind.kind == "text" or (behind.kind == "word" and behind.text.lower() not in KEYWORDS):
        for sign in PRESENCE:
            if reader.take(sign.value):
                name = _word(reader, "a name")
                return Comparison(name, sign, (), Place(start, name.place.end))
    name = _word(reader, "a name")
    sign = _sign(reader)
    values = _values(reader, sign)
    return Comparison(name, sign, values, Place(start, values[-1].place.end))


def _sign(reader: Reader) -> Sign:
    token = reader.peek()
    if token.kind == "sign" and token.text in _SIGNS:
        reader.step()
        return _SIGNS[token.text]
    negated = token.text.lower() == "not" and reader.peek(1).text.lower() == "in" and reader.take("not")
    if reader.take("in"):
        return Sign.NOT_IN if negated else Sign.IN
    if reader.take("between"):
        return Sign.BETWEEN
    raise reader.misplaced("one of = != < <= > >= ~ !~ in between")


def _values(reader: Reader, sign: Sign) -> tuple[Word, ...]:
    if sign is Sign.BETWEEN:
        low = _value(reader)
        reader.expect("and")
        return (low, _value(reader))
    if sign not in {Sign.IN, Sign.NOT_IN}:
        return (_value(reader),)
    closing = "]" if reader.take("[") else ")"
    if closing == ")":
        reader.expect("(")
    values = [_value(reader)]
    while reader.take(","):
        values.append(_value(reader))
        if len(values) > MAX_VALUES:
            raise reader.refusal(f"a list has more than {MAX_VALUES} values", values[-1].place)
    reader.expect(closing)
    return tuple(values)


def _value(reader: Reader) -> Word:
    """A word or text; a number and a unit beside it are one value."""
    value = _word(reader, "a value")
    unit = reader.peek()
    if unit.kind == "word" and unit.text in UNITS and is_number(value.text):
        reader.step()
        return Word(f"{value.text} {unit.text}", Place(value.place.start, unit.place.end))
    return value


def _word(reader: Reader, expected: str) -> Word:
    token = reader.peek()
    if token.kind not in {"word", "text"} or (token.kind == "word" and token.text.lower() in KEYWORDS):
        raise reader.misplaced(expected)
    reader.step()
    return Word(token.text, token.place, token.kind == "text")
