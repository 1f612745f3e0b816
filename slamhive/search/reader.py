"""Text to tokens, a cursor over them, and refusals that point at the place. Filters and sweep conditions share it."""

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
_SPACE = re.compile(r"\s*")
_SHOWN = 60
KEYWORDS = frozenset({"and", "or", "not", "in", "between"})
"""Words that have to be quoted to be a name or a value."""


class Place(NamedTuple):
    """Where something stands in a text: the first character and the one after the last, from 0."""

    start: int
    end: int


NOWHERE = Place(0, 0)
"""The place of what was not read from a text."""


@dataclass(frozen=True, slots=True)
class Token:
    """A ``word``, a quoted ``text`` (its quotes removed), a ``sign``, or the ``end``."""

    kind: str
    text: str
    place: Place


class FilterError(InvalidInput):
    """A text that is not understood. The message is one line; :attr:`pointer` shows the place below the text.

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


class Reader:
    """A cursor over the tokens of ``text``.

    Args:
        text: What was typed.
        title: What it is, for messages: ``filter``, ``condition``.
        example: A remedy: how such a text looks.
        longest: Most characters.
        deepest: Most levels of brackets and ``not``.
    """

    def __init__(self, text: str, title: str, example: str, *, longest: int, deepest: int) -> None:
        if len(text) > longest:
            raise InvalidInput(f"the {title} has {len(text)} characters, at most {longest} are allowed")
        self.text = text
        self.title = title
        self.example = example
        self._deepest = deepest
        self._depth = 0
        self._tokens = self._split()
        self._next = 0

    def peek(self, ahead: int = 0) -> Token:
        """The next token, or the one ``ahead`` of it; ``end`` after the last."""
        return self._tokens[min(self._next + ahead, len(self._tokens) - 1)]

    def step(self) -> Token:
        """The next token, which is consumed."""
        token = self.peek()
        self._next += 1
        return token

    def take(self, *wanted: str) -> bool:
        """Consume the next token if it is one of these signs or, in any case, words."""
        token = self.peek()
        if token.kind in {"sign", "word"} and token.text.lower() in wanted:
            self._next += 1
            return True
        return False

    def expect(self, wanted: str) -> None:
        """Consume this sign or word; refuse anything else."""
        if not self.take(wanted):
            raise self.misplaced(repr(wanted))

    def deeper(self) -> None:
        """Note that a bracket or a ``not`` was opened; refuse one level too many."""
        self._depth += 1
        if self._depth > self._deepest:
            raise self.refusal(f"the {self.title} is nested deeper than {self._deepest} levels", self.peek().place)

    def shallower(self) -> None:
        """Note that it was closed."""
        self._depth -= 1

    def misplaced(self, expected: str) -> FilterError:
        """The refusal of the next token, where ``expected`` belongs."""
        token = self.peek()
        found = "its end" if token.kind == "end" else repr(_short(token.text))
        return self.refusal(f"the {self.title} has {found} where {expected} belongs", token.place, self.example)

    def refusal(self, message: str, place: Place, remedy: str | None = None) -> FilterError:
        """An error about a part of the text."""
        return FilterError(message, remedy, self.text, place)

    def _split(self) -> list[Token]:
        tokens: list[Token] = []
        position = 0
        while (match := _TOKEN.match(self.text, position)) is not None:
            kind = str(match.lastgroup)
            found = match[kind]
            place = Place(match.start(kind), match.end(kind))
            tokens.append(Token(kind, _unquoted(found) if kind == "text" else found, place))
            position = match.end()
        space = _SPACE.match(self.text, position)
        rest = position if space is None else space.end()
        if rest < len(self.text):
            place = Place(rest, rest + 1)
            raise self.refusal(
                f"the {self.title} is not understood at {_short(self.text[rest:])!r}", place, self.example
            )
        return [*tokens, Token("end", "", Place(len(self.text), len(self.text)))]


def quoted(text: str) -> str:
    """``text`` as it has to be written to be read as one word or text again."""
    match = _TOKEN.fullmatch(text)
    if match is not None and match.lastgroup == "word" and text.lower() not in KEYWORDS and text == text.strip():
        return text
    return '"' + text.replace('"', '""') + '"'


def _unquoted(text: str) -> str:
    mark = text[0]
    return text[1:-1].replace(mark * 2, mark)


def _short(text: str) -> str:
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "…"
