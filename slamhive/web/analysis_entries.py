"""The entries of the list ``forms`` in the text of an analysis: added, replaced, moved and removed, line by line.

Everything else in the text stays as it is written, comments too.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from slamhive import strict_yaml
from slamhive.errors import InvalidInput, NotFound

_LIST = "forms"
_KIND = "form"
_OTHER_BREAKS = re.compile("[\r\x85\u2028\u2029]")
"""What ends a line for a parser of YAML besides a line feed. A text that has one is not changed line by line."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry. Its lines are those from ``begin`` up to ``end``, from 0; comments above it belong to it."""

    number: int
    begin: int
    end: int
    content: Mapping[str, Any]

    @property
    def key(self) -> str:
        """Its plot type."""
        return str(self.content.get(_KIND, ""))

    @property
    def words(self) -> str:
        """What it says besides, in one line."""
        return ", ".join(f"{name}: {_in_words(value)}" for name, value in self.content.items() if name != _KIND)


def entries(text: str) -> list[Entry]:
    """The entries in their order; none of a text that cannot be read, or whose list is in one line."""
    try:
        content, places = strict_yaml.parse_with_lines(text, "the text")
    except InvalidInput:
        return []
    found, lines = content.get(_LIST), text.split("\n")
    if not isinstance(found, list) or not found or _is_in_one_line(lines) or _OTHER_BREAKS.search(text):
        return []
    dashes = [_dash(lines, places[(_LIST, place)] - 1) for place in range(len(found))]
    last = dashes[-1] + 1
    while last < len(lines) and (not lines[last].strip() or lines[last][0] == " "):
        last += 1
    begins = [
        _comments_above(lines, dash, before + 1)
        for dash, before in zip(dashes, [places[(_LIST,)] - 1, *dashes], strict=False)
    ]
    ends = [*begins[1:], last]
    contents = [entry if isinstance(entry, dict) else {} for entry in found]
    numbered = enumerate(zip(begins, ends, contents, strict=True), start=1)
    return [Entry(number, begin, end, content) for number, (begin, end, content) in numbered]


def with_entry(text: str, added: Mapping[str, Any]) -> str:
    """The text with one more entry at the end of the list; raises InvalidInput if the list is in one line."""
    lines = text.rstrip().split("\n") if text.strip() else []
    start = _start(lines)
    if start is None:
        return "\n".join([*lines, f"{_LIST}:", *_written(added)]) + "\n"
    if _is_in_one_line(lines):
        raise _one_line()
    end = start + 1
    while end < len(lines) and (not lines[end].strip() or lines[end][0] in " -#"):
        end += 1
    written = next((line for line in lines[start + 1 : end] if line.lstrip().startswith("- ")), None)
    shifted = _written(added, None if written is None else _indent(written))
    return "\n".join([*lines[:end], *shifted, *lines[end:]]) + "\n"


def without_entry(text: str, number: int) -> str:
    """The text without one entry. Raises NotFound."""
    lines, entry = text.split("\n"), find_entry(text, number)
    return "\n".join([*lines[: entry.begin], *lines[entry.end :]])


def replaced_entry(text: str, number: int, content: Mapping[str, Any]) -> str:
    """The text with other content in the place of one entry. Comments above it stay. Raises NotFound."""
    lines, entry = text.split("\n"), find_entry(text, number)
    dash = next(place for place in range(entry.begin, entry.end) if lines[place].lstrip().startswith("-"))
    written = _written(content, _indent(lines[dash]))
    return "\n".join([*lines[:dash], *written, *_blank_end(lines, entry), *lines[entry.end :]])


def moved_entry(text: str, number: int, steps: int) -> str:
    """The text with one entry ``steps`` places later, or earlier if negative. Raises NotFound."""
    lines, (one, other) = text.split("\n"), _find(text, *sorted((number, number + steps)))
    between = lines[one.end : other.begin]
    swapped = [*lines[other.begin : other.end], *between, *lines[one.begin : one.end]]
    return "\n".join([*lines[: one.begin], *swapped, *lines[other.end :]])


def find_entry(text: str, number: int) -> Entry:
    """One entry, counted from 1. Raises NotFound."""
    return _find(text, number)[0]


def _find(text: str, *numbers: int) -> list[Entry]:
    """Several entries, of a text that is parsed once. Raises NotFound."""
    found = {entry.number: entry for entry in entries(text)}
    for number in numbers:
        if number not in found:
            if _is_in_one_line(text.split("\n")):
                raise _one_line()
            raise NotFound(f"the text has no plot {number}", f"it has {len(found)}")
    return [found[number] for number in numbers]


def _written(content: Mapping[str, Any], indent: int | None = None) -> list[str]:
    """The lines of an entry, with the dash at an indent."""
    dumped = strict_yaml.dump({_LIST: [dict(content)]}).splitlines()
    lines = [line for line in dumped if line and line != f"{_LIST}:"]
    own = _indent(lines[0])
    return [" " * (own if indent is None else indent) + line[own:] for line in lines]


def _start(lines: list[str]) -> int | None:
    """The line of the key of the list."""
    return next((place for place, line in enumerate(lines) if line.startswith(f"{_LIST}:")), None)


def _is_in_one_line(lines: list[str]) -> bool:
    start = _start(lines)
    return start is not None and bool(lines[start].partition(":")[2].partition("#")[0].strip())


def _one_line() -> InvalidInput:
    remedy = "write each plot in a line of its own, beginning with '-'"
    return InvalidInput(f"{_LIST!r} is written in one line", remedy)


def _dash(lines: list[str], line: int) -> int:
    """The line with the dash of an entry whose content begins at ``line``."""
    while line > 0 and not lines[line].lstrip().startswith("-"):
        line -= 1
    return line


def _comments_above(lines: list[str], dash: int, least: int) -> int:
    """Where the comments begin that stand right above a dash. What is indented more belongs to the entry before."""
    most, begin = _indent(lines[dash]), dash
    while begin > least and (above := lines[begin - 1]).lstrip().startswith("#") and _indent(above) <= most:
        begin -= 1
    return begin


def _blank_end(lines: list[str], entry: Entry) -> list[str]:
    """The blank lines that end an entry."""
    end = entry.end
    while not lines[end - 1].strip():
        end -= 1
    return lines[end : entry.end]


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def _in_words(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(map(_in_words, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name}: {_in_words(entry)}" for name, entry in value.items()) + "}"
    if isinstance(value, bool):
        return str(value).lower()
    return "none" if value is None else str(value)
