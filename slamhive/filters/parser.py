"""Parses filters; an error points at the part that is not understood."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from slamhive.base.errors import InvalidInput
from slamhive.filters.fields import UNITS, is_number
from slamhive.filters.syntax import (
    KEYWORDS,
    PRESENCE,
    Filter,
    FilterComparison,
    FilterError,
    FilterToken,
    leaves,
    shortened,
    split,
)

MAX_LENGTH = 50_000
MAX_DEPTH = 50
MAX_TERMS = 200
MAX_VALUES = 500
EXAMPLE = "write comparisons such as ate.rmse < 0.1, joined by and, or, not"

_TERMINALS = {"(": "OPEN", ")": "CLOSE", "[": "LSQB", "]": "RSQB", ",": "COMMA", "end": "$END", "text": "TEXT"}
_NAMES = ("WORD", "TEXT")
_EXPECTED = {
    "SIGN": "one of = != < <= > >= ~ !~ in between",
    "NOT": "a name",
    "WORD": "a value",
    "LIST_OPEN": "'('",
    "RSQB": "']'",
    "COMMA": "')'",
    "$END": "'and', 'or' or the end",
    "OR": "')'",
    "AND": "'and'",
}
"""What is expected at a place, by the first of these terminals that the grammar allows there."""


def parse_filter(
    text: str, title: str = "filter", example: str = EXAMPLE, longest: int = MAX_LENGTH, *, alone: bool = True
) -> Filter | None:
    """Parse a filter, None for an empty one; raises FilterError that points at the mistake.

    ``title`` and ``example`` are for messages; ``longest`` is the largest number of characters. ``alone``: a word alone
    is an attribute of datasets.
    """
    if len(text) > longest:
        raise InvalidInput(f"the {title} has {len(text)} characters, at most {longest} are allowed")
    tokens, unknown = split(text)
    if unknown is not None:
        found = shortened(text[unknown.start :])
        raise FilterError(f"the {title} is not understood at {found!r}", example, text, unknown)
    if len(tokens) == 1:
        return None
    tree: Filter = _parsed(text, tokens, title, example)
    _check_limits(text, tree, title)
    for leaf in leaves(tree):
        if leaf.is_alone and not alone:
            raise nothing_compared(text, leaf, title, example)
    return tree


def nothing_compared(text: str, leaf: FilterComparison, title: str = "filter", example: str = EXAMPLE) -> FilterError:
    """The error for a name that stands alone."""
    following = next(token for token in split(text)[0] if token.place.start >= leaf.place.end)
    found = "its end" if following.kind == "end" else repr(shortened(following.text))
    problem = f"the {title} has {found} where {_EXPECTED['SIGN']} belongs"
    return FilterError(problem, example, text, following.place)


def _parsed(text: str, tokens: list[FilterToken], title: str, example: str) -> Any:
    from lark import UnexpectedToken  # noqa: PLC0415 - importing Lark costs 30 ms, and few commands filter

    from slamhive.filters import filter_grammar  # noqa: PLC0415

    tree: Any = None
    parser = filter_grammar.parser()
    terminals = [filter_grammar.terminal(*pair) for pair in zip(_kinds(tokens), tokens, strict=True)]
    for index, (terminal, token) in enumerate(zip(terminals, tokens, strict=True)):
        if filter_grammar.levels(parser) > MAX_DEPTH:
            raise FilterError(f"the {title} is nested deeper than {MAX_DEPTH} levels", None, text, token.place)
        try:
            tree = parser.feed_token(terminal)
        except UnexpectedToken:
            allowed = filter_grammar.allowed_after(terminals[:index])
            expected = next(words for kind, words in _EXPECTED.items() if kind in allowed)
            found = "its end" if token.kind == "end" else repr(shortened(token.text))
            problem = f"the {title} has {found} where {expected} belongs"
            raise FilterError(problem, example, text, token.place) from None
    return tree


def _kinds(tokens: list[FilterToken]) -> Iterator[str]:
    """The terminal of the grammar for each token: ``has``, ``m`` and ``not`` depend on the tokens beside them."""
    kind = ""
    before = tokens[-1]
    for token, following in zip(tokens, [*tokens[1:], tokens[-1]], strict=True):
        kind = _kind(token, kind, before, following)
        yield kind
        before = token


def _kind(token: FilterToken, kind_before: str, before: FilterToken, following: FilterToken) -> str:
    text = token.text.lower()
    if token.kind == "sign":
        return "LIST_OPEN" if text == "(" and kind_before == "IN" else _TERMINALS.get(text, "SIGN")
    if token.kind == "word" and text in KEYWORDS:
        negates_in = text == "not" and kind_before in _NAMES and following.text.lower() == "in"
        return "NOT_IN" if negates_in else text.upper()
    # "has" and "missing" are words like any others unless a name follows.
    names = following.kind == "text" or (following.kind == "word" and following.text.lower() not in KEYWORDS)
    if token.kind == "word" and text in PRESENCE and names:
        return "PRESENCE"
    if token.kind == "word" and token.text in UNITS and kind_before in _NAMES and is_number(before.text):
        return "UNIT"
    return _TERMINALS.get(token.kind, "WORD")


def _check_limits(text: str, tree: Filter, title: str) -> None:
    found = list(leaves(tree))
    for leaf in found:
        if len(leaf.values) > MAX_VALUES:
            raise FilterError(f"a list has more than {MAX_VALUES} values", None, text, leaf.values[MAX_VALUES].place)
    if len(found) > MAX_TERMS:
        problem = f"the {title} has {len(found)} comparisons, at most {MAX_TERMS} are allowed"
        raise FilterError(problem, None, text, found[MAX_TERMS].place)
