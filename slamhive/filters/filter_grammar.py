"""The grammar of filters, parsed by Lark. Importing Lark costs 30 ms, so this module is imported late."""

from __future__ import annotations

from functools import cache
from typing import Any

from lark import Lark, Token, Transformer

from slamhive.filters import syntax
from slamhive.filters.syntax import ATTRIBUTE, SIGNS, Filter, FilterComparison, FilterPlace, Junction, Sign, Word, join

_GRAMMAR = """
disjunction: conjunction ("or" conjunction)*
conjunction: _operand ("and" _operand)*
_operand: comparison | negation | group
negation: NOT (comparison | negation | group)
group: OPEN disjunction CLOSE
?comparison: PRESENCE (WORD | TEXT | PRESENCE) -> presence
    | name SIGN value -> one
    | name BETWEEN value "and" value -> between
    | name NOT_IN? "in" _list -> among
    | name -> alone
_list: "[" value ("," value)* "]"
    | LIST_OPEN value ("," value)* _list_close
_list_close: CLOSE
name: WORD | TEXT
value: (WORD | TEXT | PRESENCE) UNIT?
%declare WORD TEXT UNIT PRESENCE SIGN BETWEEN NOT NOT_IN OPEN LIST_OPEN CLOSE
"""


def parser() -> Any:
    """A parser at the beginning of a text. It is fed with terminals: what a word is depends on the words beside it."""
    return _lark().parse_interactive()


@cache
def _lark() -> Lark:
    return Lark(_GRAMMAR, start="disjunction", parser="lalr", lexer="basic", transformer=_Builder())


def terminal(kind: str, token: syntax.FilterToken) -> Token:
    """The token as a terminal of the grammar."""
    return Token(kind, token.text, token.place.start, end_pos=token.place.end)


def allowed_after(terminals: list[Token]) -> set[str]:
    """The kinds of terminals that may follow. A parser that refused one may have reduced too much to know them."""
    fresh = parser()
    for entry in terminals:
        fresh.feed_token(entry)
    allowed: set[str] = fresh.accepts()
    return allowed


def levels(parser: Any) -> int:
    """Number of open brackets and ``not``."""
    stack = parser.parser_state.value_stack
    return sum(isinstance(entry, Token) and entry.type in {"NOT", "OPEN"} for entry in stack)


class _Builder(Transformer[Token, Filter]):
    """One method for each rule of the grammar; ``parts`` are the results of its parts."""

    def disjunction(self, parts: list[Filter]) -> Filter:
        return join("or", parts)

    def conjunction(self, parts: list[Filter]) -> Filter:
        return join("and", parts)

    def negation(self, parts: list[Any]) -> Filter:
        return Junction("not", (parts[1],))

    def group(self, parts: list[Any]) -> Any:
        return parts[1]

    def presence(self, parts: list[Token]) -> Filter:
        sign, name = parts
        return FilterComparison(_word(name), Sign(sign.lower()), (), _span(sign, name))

    def one(self, parts: list[Any]) -> Filter:
        name, sign, value = parts
        return _comparison(name, SIGNS[sign], (value,))

    def between(self, parts: list[Any]) -> Filter:
        name, _, low, high = parts
        return _comparison(name, Sign.BETWEEN, (low, high))

    def among(self, parts: list[Any]) -> Filter:
        denied = any(isinstance(part, Token) and part.type == "NOT_IN" for part in parts)
        name, *values = (part for part in parts if isinstance(part, Word))
        return _comparison(name, Sign.NOT_IN if denied else Sign.IN, tuple(values))

    def alone(self, parts: list[Word]) -> Filter:
        (word,) = parts
        return FilterComparison(Word(ATTRIBUTE, word.place), Sign.EQUAL, (word,), word.place)

    def name(self, parts: list[Token]) -> Word:
        return _word(parts[0])

    def value(self, parts: list[Token]) -> Word:
        if len(parts) == 1:
            return _word(parts[0])
        number, unit = parts
        return Word(f"{number} {unit}", _span(number, unit))


def _comparison(name: Word, sign: Sign, values: tuple[Word, ...]) -> FilterComparison:
    return FilterComparison(name, sign, values, FilterPlace(name.place.start, values[-1].place.end))


def _word(token: Token) -> Word:
    return Word(str(token), _span(token, token), token.type == "TEXT")


def _span(first: Token, last: Token) -> FilterPlace:
    return FilterPlace(first.start_pos or 0, last.end_pos or 0)
