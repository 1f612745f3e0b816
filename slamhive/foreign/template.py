"""The placeholders of ``template.yaml``, which published scripts fill with ``string.Template``."""

from __future__ import annotations

import re
import string
from collections.abc import Iterator
from dataclasses import dataclass

_COMMENT = re.compile(r"\s#\s*(\S.*)$")
_VALUE = re.compile(r"""^\s*([A-Za-z][\w.]*)\s*:\s*["']?([^"'#$]*?)["']?\s*(?:#.*)?$""")


@dataclass(frozen=True, slots=True)
class Placeholder:
    """A placeholder: its name, the line where it first stands, and the comment beside it (empty if none)."""

    name: str
    line: int
    comment: str = ""


def read_placeholders(text: str) -> tuple[list[Placeholder], list[str]]:
    """The placeholders of a template, each once, and in words what ``substitute`` will refuse in it."""
    found: dict[str, Placeholder] = {}
    problems: list[str] = []
    for number, line in enumerate(text.splitlines(), start=1):
        for match in string.Template.pattern.finditer(line):
            name = match["named"] or match["braced"]
            if name is not None and name not in found:
                comment = _COMMENT.search(line)
                found[name] = Placeholder(name, number, comment[1].strip() if comment else "")
            elif match["invalid"] is not None:
                problems.append(f"line {number} has a $ without a name")
    return list(found.values()), problems


def filled_values(template: str, filled: str) -> dict[str, str]:
    """The values of placeholders in ``filled``, which was made from a template with the same lines."""
    values: dict[str, str] = {}
    lines: dict[str, str] = {}
    for line in filled.splitlines():
        head, colon, rest = line.partition(":")
        if colon:
            lines.setdefault(head.strip(), rest)
    for line in template.splitlines():
        head, colon, rest = line.partition(":")
        match = string.Template.pattern.search(rest) if colon else None
        name = (match["named"] or match["braced"]) if match else None
        if name is not None and head.strip() in lines:
            values.setdefault(name, lines[head.strip()].partition(" #")[0].strip().strip("\"'"))
    return values


def fixed_values(text: str) -> Iterator[tuple[str, str]]:
    """(key, value) of the lines of a template that hold no placeholder."""
    for line in text.splitlines():
        match = _VALUE.match(line) if len(line) <= 1000 else None
        if match:
            yield match[1], match[2].strip()
