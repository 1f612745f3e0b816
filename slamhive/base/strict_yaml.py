"""YAML 1.2 from outside, without its traps: no tags, no anchors, no duplicate keys, nothing deep or huge.

The parser is ruamel.yaml's (its C part where installed); what plain words mean is decided here, by the core schema of
YAML 1.2. The controller uses this module, and the runtime uses it inside algorithm images.
"""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML, events
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from slamhive.base import bounds
from slamhive.base.errors import InvalidInput

MAX_BYTES = 2_000_000
MAX_DEPTH = 20
_COLON_REFUSED = "found unexpected ':'"
_MOST_READ_SLOWLY = 200_000

Lines = dict[tuple[str | int, ...], int]
"""The line, from 1, of each key (text) and list item (position from 0), by the path that leads to it."""


@dataclass(frozen=True, slots=True)
class YamlPlace:
    """Where something was written; ``line`` counts from 1 and is None where there is no text."""

    source: str
    line: int | None = None

    def __str__(self) -> str:
        return self.source if self.line is None else f"{self.source} line {self.line}"


class Places:
    """Where each part of a file was written.

    Args:
        source: The name of the file in messages.
        lines: As :func:`parse_with_lines` returns them.
    """

    def __init__(self, source: str, lines: Lines) -> None:
        self._source = source
        self._lines = lines

    def of(self, *path: str | int) -> YamlPlace:
        """The place of ``path``, or of the nearest part that contains it."""
        for length in range(len(path), 0, -1):
            line = self._lines.get(path[:length])
            if line is not None:
                return YamlPlace(self._source, line)
        return YamlPlace(self._source)


def parse(text: str, source: str) -> dict[str, Any]:
    """Parse ``text`` into a mapping.

    Args:
        text: The YAML.
        source: What to call it in messages, usually the path.

    Raises:
        InvalidInput: naming the source, the line and the problem.
    """
    return parse_with_lines(text, source)[0]


def parse_with_lines(text: str, source: str) -> tuple[dict[str, Any], Lines]:
    """Parse as :func:`parse` does; also return the line of every key and item."""
    if len(text) > MAX_BYTES:
        raise bounds.too_large(source, MAX_BYTES)
    try:
        content, lines = _read(text)
    except MarkedYAMLError as error:
        last_line = text.count("\n", 0, len(text) - 1) + 1  # the parser places an early end behind the last line
        line = f" line {min(error.problem_mark.line + 1, last_line)}" if error.problem_mark else ""
        raise InvalidInput(f"{source}{line}: {error.problem or 'not valid YAML'}") from None
    except (YAMLError, ValueError) as error:
        raise InvalidInput(f"{source}: not valid YAML ({error})") from None
    if not isinstance(content, dict):
        found = "nothing" if content is None else type(content).__name__
        raise InvalidInput(f"{source}: expected keys with values at the top level, found {found}")
    broken = bounds.find_problem(content, deepest=MAX_DEPTH)
    if broken is not None:
        path, problem = broken
        raise InvalidInput(f"{Places(source, lines).of(*path)}: {'.'.join(path)}: {problem}")
    return content, lines


def _read(text: str) -> tuple[Any, Lines]:
    """The content of ``text`` and its lines; raises YAMLError and ValueError."""
    document = _Document(text, pure=False)
    try:
        return document.read(), document.lines
    except MarkedYAMLError as error:
        if error.problem != _COLON_REFUSED or len(text) > _MOST_READ_SLOWLY:
            raise
    # libyaml refuses ranges in short lists ("[1:3, x]"), which YAML allows. The Python parser takes 5 s for 1 MB.
    document = _Document(text, pure=True)
    return document.read(), document.lines


class _Document:
    """Builds the values of one document from the parser's events."""

    def __init__(self, text: str, *, pure: bool) -> None:
        self._events: Iterator[Any] = YAML(typ="safe", pure=pure).parse(text)
        self.lines: Lines = {}

    def read(self) -> Any:
        content, found = None, False
        for event in self._events:
            if isinstance(event, events.DocumentStartEvent):
                if found:
                    raise _refusal("a second document begins, expected one", event)
                content, found = self._value(next(self._events), ()), True
        return content

    def _value(self, event: Any, path: tuple[str | int, ...]) -> Any:
        _check_node(event, len(path))
        if isinstance(event, events.ScalarEvent):
            return _plain_value(event) if event.implicit[0] else event.value
        if isinstance(event, events.MappingStartEvent):
            return self._mapping(path)
        return self._sequence(path)

    def _mapping(self, path: tuple[str | int, ...]) -> dict[str, Any]:
        content: dict[str, Any] = {}
        while not isinstance(event := next(self._events), events.MappingEndEvent):
            _check_node(event, len(path) + 1)
            if not isinstance(event, events.ScalarEvent):
                raise _refusal("a key must be plain text", event)
            key = event.value  # text, even if it looks like a number or a truth value
            if key in content:
                raise _refusal(f"the key {key!r} appears twice", event)
            self.lines[(*path, key)] = event.start_mark.line + 1
            content[key] = self._value(next(self._events), (*path, key))
        return content

    def _sequence(self, path: tuple[str | int, ...]) -> list[Any]:
        items: list[Any] = []
        while not isinstance(event := next(self._events), events.SequenceEndEvent):
            place = (*path, len(items))
            self.lines[place] = event.start_mark.line + 1
            items.append(self._value(event, place))
        return items


def _check_node(event: Any, depth: int) -> None:
    if isinstance(event, events.AliasEvent) or event.anchor is not None:
        raise _refusal("anchors and aliases are not allowed", event)
    if event.tag is not None:
        raise _refusal(f"the tag {event.tag} is not allowed", event)
    if depth >= MAX_DEPTH:
        raise _refusal(f"nested deeper than {MAX_DEPTH} levels", event)


def _refusal(problem: str, event: events.Event) -> MarkedYAMLError:
    return MarkedYAMLError(problem=problem, problem_mark=event.start_mark)


_CORE_SCHEMA = re.compile(
    r"""(?P<null> ~ | null | Null | NULL | )
    | (?P<true> true | True | TRUE )
    | (?P<false> false | False | FALSE )
    | (?P<decimal> [-+]? [0-9]+ )
    | 0o (?P<octal> [0-7]+ )
    | 0x (?P<hexadecimal> [0-9a-fA-F]+ )
    | (?P<float> [-+]? ( \. [0-9]+ | [0-9]+ ( \. [0-9]* )? ) ( [eE] [-+]? [0-9]+ )? )
    | (?P<infinite> [-+]? ) \. ( inf | Inf | INF )
    | \. (?P<nan> nan | NaN | NAN )""",
    re.VERBOSE,
)
"""What is not text if written without quotation marks (YAML 1.2, section 10.3.2)."""

_BASES = {"decimal": 10, "octal": 8, "hexadecimal": 16}
_CONSTANTS = {"null": None, "true": True, "false": False}


def _plain_value(event: events.ScalarEvent) -> Any:
    match = _CORE_SCHEMA.fullmatch(event.value)
    if match is None:
        return event.value
    kind = str(match.lastgroup)
    if kind in _CONSTANTS:
        return _CONSTANTS[kind]
    if kind not in _BASES:
        return float(event.value.replace(".inf", "inf").replace(".nan", "nan"))
    try:
        return int(match[kind], _BASES[kind])
    except ValueError:  # Python reads no whole number of more than 4,300 digits
        raise _refusal("a value is not a number that can be used", event) from None


def read_text(path: Path) -> str:
    """The text of the file at ``path``; raises InvalidInput if it is larger than any YAML file may be."""
    return bounds.read_text(path, MAX_BYTES)


def load(path: Path) -> dict[str, Any]:
    """Parse the file at ``path``; raises InvalidInput as :func:`parse` and :func:`read_text`."""
    return parse(read_text(path), str(path))


def dump(content: dict[str, Any]) -> str:
    """``content`` as YAML in the given key order; short lists stay on one line.

    Readers of YAML 1.1 find the same values in it: the images of published algorithms have such readers.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.allow_unicode = True
    yaml.width = 110
    stream = io.StringIO()
    document: list[events.Event] = [
        events.StreamStartEvent(),
        events.DocumentStartEvent(explicit=False),
        *_events(content),
        events.DocumentEndEvent(explicit=False),
        events.StreamEndEvent(),
    ]
    yaml.emit(document, stream)
    return re.sub(r" +$", "", stream.getvalue(), flags=re.MULTILINE)  # the emitter leaves them where it breaks lists


def _events(value: Any, *, in_one_line: bool = False) -> Iterator[events.Event]:
    if isinstance(value, dict):
        yield events.MappingStartEvent(None, None, implicit=True, flow_style=not value)
        for key, item in value.items():
            yield from _events(key)
            yield from _events(item)
        yield events.MappingEndEvent()
    elif isinstance(value, list | tuple):
        plain = not any(isinstance(item, dict | list | tuple) for item in value)  # a matrix, on one line
        yield events.SequenceStartEvent(None, None, implicit=True, flow_style=plain)
        for item in value:
            yield from _events(item, in_one_line=plain)
        yield events.SequenceEndEvent()
    elif isinstance(value, str):
        style = '"' if _LINE_BREAKS.search(value) else None
        # In a list on one line, the C parser takes these for signs. The emitter does not know that.
        sign = in_one_line and ("?" in value or value.startswith(":"))
        bare = not (sign or _NEEDS_QUOTES.fullmatch(value))
        yield events.ScalarEvent(None, _text_tag(), (bare, True, True), value, style=style)
    else:
        text = "null" if value is None else repr(value)
        if isinstance(value, bool):
            text = text.lower()
        elif "." not in text:
            text = text.replace("e", ".0e")  # YAML 1.1 takes 1e-9 for text
        yield events.ScalarEvent(None, None, (True, False, True), text)


_YAML_1_1 = r"""
      y | Y | yes | Yes | YES | n | N | no | No | NO | on | On | ON | off | Off | OFF | = | <<
    | [-+]? [0-9] [0-9_]* ( : [0-5]? [0-9] )* ( \. [0-9_]* )? ( [eE] [-+]? [0-9]+ )? | [-+]? \. [0-9_]+
    | [-+]? 0b [01_]+ | [-+]? 0x [0-9a-fA-F_]+
    | [0-9]{4} - [0-9]{1,2} - [0-9]{1,2} ( ( [Tt] | [ \t]+ ) [0-9] .* )?"""
_LINE_BREAKS = re.compile("[\n\x85\u2028\u2029]")
_NEEDS_QUOTES = re.compile(f"{_CORE_SCHEMA.pattern} | {_YAML_1_1}", re.VERBOSE)
"""Text that a reader of either version takes for something else, unless it is in quotation marks."""


@functools.cache
def _text_tag() -> Any:
    """Only for writing: Debian's older ruamel.yaml, with which images of ROS read, does not have it."""
    from ruamel.yaml.tag import Tag  # noqa: PLC0415

    return Tag(suffix="tag:yaml.org,2002:str")
