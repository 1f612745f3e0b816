"""Splits filters into tokens, and points at mistakes. Conditions of experiments use it too."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

from slamhive.errors import InvalidInput

_TOKEN = re.compile(
    r"""\s*(?:(?P<text>"[^"]*(?:""[^"]*)*"|'[^']*(?:''[^']*)*')
    |(?P<sign>=>|=<|<=|>=|==|!=|!~|[<>=~(),\[\]])
    |(?P<word>[^\s"'<>=~!(),\[\]]+))""",
    re.VERBOSE,
)
_SHOWN = 60
KEYWORDS = frozenset({"and", "or", "not", "in", "between"})
"""Words that need quotes to be a name or a value."""


class Place(NamedTuple):
    """A place in a text: the first character and the one after the last, from 0."""

    start: int
    end: int


NOWHERE = Place(0, 0)
"""The place of something that was not read from a text."""


@dataclass(frozen=True, slots=True)
class Token:
    """A ``word``, a quoted ``text`` (its quotes removed), a ``sign``, or the ``end``."""

    kind: str
    text: str
    place: Place


class FilterError(InvalidInput):
    """A mistake in a filter. The message is one line; :attr:`pointer` marks the place below the text.

    Args:
        message: What is wrong.
        remedy: What to do.
        source: The whole text.
        place: The part of it that is meant.
    """

    def __init__(self, message: str, remedy: str | None, source: str, place: Place) -> None:
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


def split(text: str) -> tuple[list[Token], Place | None]:
    """The tokens of ``text``, and the place of the first character that begins none, if there is one."""
    tokens: list[Token] = []
    position = 0
    while (match := _TOKEN.match(text, position)) is not None:
        kind = str(match.lastgroup)
        found = match[kind]
        place = Place(match.start(kind), match.end(kind))
        tokens.append(Token(kind, _unquoted(found) if kind == "text" else found, place))
        position = match.end()
    rest = len(text) - len(text[position:].lstrip())
    tokens.append(Token("end", "", Place(len(text), len(text))))
    return tokens, Place(rest, rest + 1) if rest < len(text) else None


def quoted(text: str) -> str:
    """``text`` in quotes if it needs them to be read as one word."""
    match = _TOKEN.fullmatch(text)
    if match is not None and match.lastgroup == "word" and text.lower() not in KEYWORDS and text == text.strip():
        return text
    return '"' + text.replace('"', '""') + '"'


def _unquoted(text: str) -> str:
    mark = text[0]
    return text[1:-1].replace(mark * 2, mark)


def shortened(text: str) -> str:
    """``text`` as a message shows it."""
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "…"
