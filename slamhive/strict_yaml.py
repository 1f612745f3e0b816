"""YAML from outside, without its traps: no tags, no anchors, no duplicate keys, nothing deep or huge.

Text and numbers follow the rule of :mod:`slamhive.input_bounds`. Used by the controller and, inside the algorithm
images, by the runtime; depends on PyYAML alone.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from slamhive import input_bounds
from slamhive.errors import InvalidInput

MAX_BYTES = 2_000_000
MAX_DEPTH = 20

Lines = dict[tuple[str | int, ...], int]
"""The line, from 1, of each key (text) and list item (position from 0), by the path that leads to it."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where something was written; ``line`` counts from 1 and is None where there is no text."""

    source: str
    line: int | None = None

    def __str__(self) -> str:
        return self.source if self.line is None else f"{self.source} line {self.line}"


class Places:
    """Where each part of a file stands.

    Args:
        source: What messages call the file.
        lines: As :func:`parse_with_lines` gives them.
    """

    def __init__(self, source: str, lines: Lines) -> None:
        self._source = source
        self._lines = lines

    def of(self, *path: str | int) -> Place:
        """The place of ``path``, or of the nearest thing around it."""
        for length in range(len(path), 0, -1):
            line = self._lines.get(path[:length])
            if line is not None:
                return Place(self._source, line)
        return Place(self._source)


_NUMBER_TAGS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that refuses aliases, explicit tags, duplicate keys and deep nesting."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise _refusal("anchors and aliases are not allowed", event.start_mark)
        if getattr(event, "tag", None):
            raise _refusal(f"the tag {event.tag} is not allowed", event.start_mark)
        if self.depth >= MAX_DEPTH:
            raise _refusal(f"nested deeper than {MAX_DEPTH} levels", event.start_mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        if not isinstance(node, yaml.ScalarNode):
            return super().construct_object(node, deep=deep)
        try:
            return super().construct_object(node, deep=deep)
        except ValueError:  # Python reads no whole number of more than 4,300 digits
            raise _refusal("a value is not a number that can be used", node.start_mark) from None

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise _refusal("a key must be plain text", key_node.start_mark)
            if key_node.value in seen:
                raise _refusal(f"the key {key_node.value!r} appears twice", key_node.start_mark)
            seen.add(key_node.value)
        self.flatten_mapping(node)
        # A key is text, also if it reads like a number, a truth value or nothing at all.
        return {key_node.value: self.construct_object(value_node, deep=deep) for key_node, value_node in node.value}


def _without_surprises(resolvers: dict[str, list[tuple[str, re.Pattern[str]]]]) -> dict[str, list[Any]]:
    """YAML 1.1 reads 1:30:20 as a number to base 60, and 2026-01-31 as a date; here both are text."""
    plain: dict[str, list[Any]] = {}
    for first, entries in resolvers.items():
        plain[first] = [
            (tag, re.compile(rf"(?![^:]*:\d)(?:{pattern.pattern})", pattern.flags) if tag in _NUMBER_TAGS else pattern)
            for tag, pattern in entries
            if tag != "tag:yaml.org,2002:timestamp"
        ]
    return plain


_StrictLoader.yaml_implicit_resolvers = _without_surprises(yaml.SafeLoader.yaml_implicit_resolvers)

_SCIENTIFIC = re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+$")
"""1e-9: text in YAML 1.1, as it lacks a point; a number in YAML 1.2 (section 10.3.2)."""


class _Dumper(yaml.SafeDumper):
    """SafeDumper without aliases."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002 - PyYAML's signature
        return True


def _represent_list(dumper: yaml.SafeDumper, items: list[Any]) -> yaml.Node:
    """Lists of plain values on one line (matrices), all else in blocks."""
    flat = not any(isinstance(item, dict | list) for item in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flat)


_Dumper.add_representer(list, _represent_list)

for _yaml in (_StrictLoader, _Dumper):  # the dumper, too: text that looks like a number is to be quoted
    _yaml.add_implicit_resolver("tag:yaml.org,2002:float", _SCIENTIFIC, list("-+0123456789"))


def _refusal(problem: str, mark: yaml.Mark) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


def parse(text: str, source: str) -> dict[str, Any]:
    """Parse ``text`` into a mapping.

    Args:
        text: The YAML.
        source: What to call it in messages, usually the path.

    Raises:
        InvalidInput: naming the source, the line and what is wrong with it.
    """
    content, _ = _parse_node(text, source)
    return content


def parse_with_lines(text: str, source: str) -> tuple[dict[str, Any], Lines]:
    """Parse as :func:`parse` does, and tell where everything stands."""
    content, node = _parse_node(text, source)
    lines: Lines = {}
    _collect_lines(node, (), lines)
    return content, lines


def _parse_node(text: str, source: str) -> tuple[dict[str, Any], yaml.Node]:
    if len(text) > MAX_BYTES:
        raise input_bounds.too_large(source, MAX_BYTES)
    try:
        loader = _StrictLoader(text)
        node = loader.get_single_node()
        content = None if node is None else loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        line = f" line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InvalidInput(f"{source}{line}: {error.problem or 'not valid YAML'}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InvalidInput(f"{source}: not valid YAML ({error})") from None
    if node is None or not isinstance(content, dict):
        found = "nothing" if content is None else type(content).__name__
        raise InvalidInput(f"{source}: expected keys with values at the top level, found {found}")
    _check_bounds(content, node, source)
    return content, node


def _check_bounds(content: dict[str, Any], node: yaml.Node, source: str) -> None:
    found = input_bounds.find_problem(content, deepest=MAX_DEPTH)
    if found is not None:
        lines: Lines = {}
        _collect_lines(node, (), lines)
        path, problem = found
        raise InvalidInput(f"{Places(source, lines).of(*path)}: {'.'.join(path)}: {problem}")


def _collect_lines(node: yaml.Node, path: tuple[str | int, ...], lines: Lines) -> None:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            lines[(*path, key.value)] = key.start_mark.line + 1
            _collect_lines(value, (*path, key.value), lines)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            lines[(*path, index)] = item.start_mark.line + 1
            _collect_lines(item, (*path, index), lines)


def read_text(path: Path) -> str:
    """The text of the file at ``path``, of which no more is read than may be YAML; raises InvalidInput."""
    return input_bounds.read_text(path, MAX_BYTES)


def load(path: Path) -> dict[str, Any]:
    """Parse the file at ``path``; raises InvalidInput as :func:`parse` and :func:`read_text`."""
    return parse(read_text(path), str(path))


def dump(content: dict[str, Any]) -> str:
    """``content`` as YAML in the given key order; short lists stay on one line."""
    return yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=False, width=110)
