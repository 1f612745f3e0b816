"""Arguments and fixed topics of ROS launch files. They are searched for tags, so that no XML parser meets the file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

_TAG = re.compile(r"<(arg|remap)\b([^<>]{0,2000})>")
_ATTRIBUTE = re.compile(r"""\b(name|default|value|from|to|doc)\s*=\s*(?:"([^"]*)"|'([^']*)')""")


@dataclass(frozen=True, slots=True)
class LaunchArgument:
    """An argument of a launch file that may be given at the start; ``default`` is None if it must be."""

    name: str
    default: str | None
    doc: str = ""


@dataclass(frozen=True, slots=True)
class Launch:
    """What a launch file says: its arguments, and the topics that it remaps to, which nobody can change."""

    arguments: tuple[LaunchArgument, ...]
    fixed_topics: tuple[str, ...]


def read_launch(text: str) -> Launch:
    """Read a launch file; what is commented out does not count."""
    arguments: dict[str, LaunchArgument] = {}
    topics: dict[str, None] = {}
    for tag in _TAG.finditer(without_comments(text)):
        found = {name: double or single for name, double, single in _ATTRIBUTE.findall(tag[2])}
        if tag[1] == "arg" and found.get("name") and "value" not in found:
            arguments[found["name"]] = LaunchArgument(found["name"], found.get("default"), found.get("doc", ""))
        elif tag[1] == "remap" and found.get("to") and "$(" not in found["to"]:
            topics[found["to"]] = None
    return Launch(tuple(arguments.values()), tuple(topics))


def without_comments(text: str) -> str:
    """``text`` without XML comments; one that never ends hides the rest."""
    return "".join(_pieces(text))


def _pieces(text: str) -> Iterator[str]:
    place = 0
    while (start := text.find("<!--", place)) >= 0:
        yield text[place:start]
        end = text.find("-->", start + 4)
        if end < 0:
            return
        place = end + 3
    yield text[place:]
