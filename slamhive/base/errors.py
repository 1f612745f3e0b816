"""The errors of SLAM Hive: every mistake a user can make becomes one of these, and one clear line.

The message says what was found (naming the value), the remedy what to do about it. The command line prints
``str(error)`` and exits with 1; the web layer maps each kind to an HTTP status. Anything else that escapes is a
bug and keeps its traceback.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from difflib import get_close_matches

CONTROL_CHARACTERS = r"\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x84\x86-\x9f\ufffe\uffff"
"""What YAML calls not printable (section 5.1), as a part of a regular expression: tab and line ends are fine."""
SURROGATES = r"\ud800-\udfff"
"""Halves of pairs, as a part of a regular expression: text that holds one cannot be encoded."""
LONGEST_MESSAGE = 2000
_NOT_SHOWN = re.compile(f"[{CONTROL_CHARACTERS}{SURROGATES}]")
_CHANGE: ContextVar[Callable[[str], str] | None] = ContextVar("slamhive_error_text", default=None)


@contextmanager
def changed_text(change: Callable[[str], str]) -> Iterator[None]:
    """Pass the texts of all errors that this thread makes in the block through ``change``.

    A server uses it to keep its paths to itself, whichever of its parts shows an error.
    """
    before = _CHANGE.get()
    _CHANGE.set(change)
    try:
        yield
    finally:
        _CHANGE.set(before)


class SlamHiveError(Exception):
    """Root of all errors that are explained to the user rather than traced.

    Args:
        message: What was expected and what was found, naming the value.
        remedy: What the user can do about it, optional.
    """

    def __init__(self, message: str, remedy: str | None = None) -> None:
        change = _CHANGE.get() or str
        self.message = one_line(change(message))
        self.remedy = one_line(change(remedy)) if remedy else None
        super().__init__(self.message if self.remedy is None else f"{self.message}; {self.remedy}")


class InvalidInput(SlamHiveError):
    """A value, a file or a combination of values that cannot be used."""


class NotFound(SlamHiveError):
    """A name or identifier that nothing answers to."""


class Conflict(SlamHiveError):
    """The request is well-formed but does not fit the present state (a name taken, a run that has ended)."""


class Forbidden(SlamHiveError):
    """The mode in force, or the role of the account, does not allow this."""


class Unauthenticated(SlamHiveError):
    """The server does not know who asks."""


class Unavailable(SlamHiveError):
    """Something outside this process does not answer (Docker engine, database, disk space, a library).

    Args:
        message: As for all errors.
        remedy: As for all errors.
        retry_after_s: After how many seconds it is worth to try again, where that is known.
    """

    def __init__(self, message: str, remedy: str | None = None, *, retry_after_s: int | None = None) -> None:
        super().__init__(message, remedy)
        self.retry_after_s = retry_after_s


class TooManyRequests(Unavailable):
    """The same has been asked for too often; later it is answered again."""


def one_line(text: str) -> str:
    """``text`` on one line that every terminal, log and page can show: what is not text is written as an escape."""
    escaped = _NOT_SHOWN.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)
    line = " ".join(escaped.split())
    if len(line) <= LONGEST_MESSAGE:
        return line
    half = LONGEST_MESSAGE // 2  # the value that is too long stands in the middle, what is wrong with it at the end
    return f"{line[:half]} … {line[-half:]}"


def unknown(kind: str, name: str, known: list[str], remedy: str | None = None) -> NotFound:
    """The one wording for a name that nothing answers to; suggests the nearest known name."""
    return NotFound(f"unknown {kind} {name!r}; {nearest(name, known)}", remedy)


def lacks(owner: str, kind: str, name: str, known: list[str]) -> NotFound:
    """The wording for a name that ``owner`` does not have: ``kiss-icp has no parameter 'voxl_size'; did you ...``."""
    return NotFound(f"{owner} has no {kind} {name!r}; {nearest(name, known)}")


_MAX_NAMED = 40


def nearest(name: str, known: list[str]) -> str:
    """The known name that is most like ``name`` as a question, or the known names, as many as fit into a line."""
    near = get_close_matches(name, known, n=1)
    if near:
        return f"did you mean {near[0]!r}?"
    names = sorted(set(known))
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return f"known: {', '.join(names[:_MAX_NAMED]) or 'none'}{more}"
