"""Keys that a script reads of its configuration, found in its syntax tree. Nothing is imported or executed."""

from __future__ import annotations

import ast
import re
import string
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

_SECTIONS = frozenset(
    {
        *("slam-hive", "slam-hive-algorithm", "slam-hive-dataset", "algorithm-parameters", "dataset-parameters"),
        *("algorithm-remap", "dataset-remap", "dataset-frequency", "dataset-resolution", "general-parameter"),
        *("algorithm-attribute", "dataset-attribute"),
    }
)
_KEY = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
_OLD_IMPORT = re.compile(r"^[ \t]*(?:import|from)[ \t]+(\w[\w.]*(?:[ \t]*,[ \t]*\w[\w.]*)*)", re.MULTILINE)
_OLD_KEY = re.compile(r"""(?:\[|\.get\()[ \t]*(['"])([^'"\\\n]{1,64})\1""")
_OLD_TEXT = re.compile(r"""(['"])([^'"\\\n]{1,300})\1""")


@dataclass(frozen=True, slots=True)
class PackageScript:
    """Findings in one Python file.

    Attributes:
        keys: Names that it looks up in dictionaries, without the sections of ``config.yaml``.
        sections: The sections of ``config.yaml`` that it reads.
        numbers: Keys that it converts, with ``int`` or ``float``.
        imports: The top-level modules that it imports.
        texts: Its string constants.
        reads: Files below ``/slamhive`` that it opens to read.
        problem: Why it is no Python 3; it was then read by patterns, which may miss keys. None if it is.
    """

    keys: tuple[str, ...] = ()
    sections: frozenset[str] = frozenset()
    numbers: tuple[tuple[str, str], ...] = ()
    imports: tuple[str, ...] = ()
    texts: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    problem: str | None = None


def read_script(text: str) -> PackageScript:
    """Read Python source; older Python is read by patterns, and says so in ``problem``."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(text)
    except SyntaxError as error:
        return _read_by_patterns(text, f"line {error.lineno or 1}: {error.msg}")
    except (ValueError, RecursionError, MemoryError) as error:
        return _read_by_patterns(text, str(error) or "it is nested too deeply")
    names: dict[str, None] = {}
    numbers: dict[str, str] = {}
    imports: dict[str, None] = {}
    texts: dict[str, None] = {}
    reads: dict[str, None] = {}
    for node in ast.walk(tree):
        names.update(dict.fromkeys(_keys_of(node)))
        if isinstance(node, ast.Import):
            imports.update(dict.fromkeys(alias.name.partition(".")[0] for alias in node.names))
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            imports[node.module.partition(".")[0]] = None
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts[node.value] = None
        if isinstance(node, ast.Call):
            numbers.update(_conversion(node))
            reads.update(dict.fromkeys(_opened(node)))
    return PackageScript(
        keys=tuple(name for name in names if _KEY.fullmatch(name) and name not in _SECTIONS),
        sections=_SECTIONS & names.keys(),
        numbers=tuple(numbers.items()),
        imports=tuple(imports),
        texts=tuple(texts),
        reads=tuple(reads),
    )


def _keys_of(node: ast.AST) -> Iterator[str]:
    """``x["key"]``, ``x.get("key")`` and ``name == "key"``, but not variables of the environment."""
    if isinstance(node, ast.Subscript) and not _is_environment(node.value):
        yield from _text_of(node.slice)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.args:
        if node.func.attr == "get" and not _is_environment(node.func.value):
            yield from _text_of(node.args[0])
    elif isinstance(node, ast.Compare) and isinstance(node.left, ast.Name) and node.left.id in {"key", "k", "name"}:
        yield from _text_of(node.comparators[0])


def _is_environment(node: ast.expr) -> bool:
    return isinstance(node, ast.Attribute) and node.attr == "environ"


def _text_of(node: ast.expr) -> Iterator[str]:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value


def _conversion(node: ast.Call) -> dict[str, str]:
    """``float(x["fps"])`` says that fps is a number."""
    if isinstance(node.func, ast.Name) and node.func.id in {"int", "float"} and len(node.args) == 1:
        argument = node.args[0]
        if isinstance(argument, ast.Subscript):
            return dict.fromkeys(_text_of(argument.slice), node.func.id)
    return {}


def _opened(node: ast.Call) -> Iterator[str]:
    """Files below ``/slamhive`` that ``open`` reads."""
    if not (isinstance(node.func, ast.Name) and node.func.id == "open" and node.args):
        return
    modes = [node.args[1]] if len(node.args) > 1 else [word.value for word in node.keywords if word.arg == "mode"]
    mode = next(iter(_text_of(modes[0])), "") if modes else "r"
    for path in _text_of(node.args[0]):
        if path.startswith("/slamhive/") and set(mode).isdisjoint("wax+"):
            yield path.removeprefix("/slamhive/")


def _read_by_patterns(text: str, problem: str) -> PackageScript:
    names = dict.fromkeys(found[2] for found in _OLD_KEY.finditer(text))
    imports = (part.strip().partition(".")[0] for found in _OLD_IMPORT.finditer(text) for part in found[1].split(","))
    return PackageScript(
        keys=tuple(name for name in names if _KEY.fullmatch(name) and name not in _SECTIONS),
        sections=_SECTIONS & names.keys(),
        imports=tuple(dict.fromkeys(imports)),
        texts=tuple(dict.fromkeys(found[2] for found in _OLD_TEXT.finditer(text))),
        problem=problem,
    )


# Arguments and fixed topics of ROS launch files. They are searched for tags, so that no XML parser meets the file.


_TAG = re.compile(r"<(arg|remap)\b([^<>]{0,2000})>")
_ATTRIBUTE = re.compile(r"""\b(name|default|value|from|to|doc)\s*=\s*(?:"([^"]*)"|'([^']*)')""")


@dataclass(frozen=True, slots=True)
class LaunchArgument:
    """An argument of a launch file that may be given at the start; ``default`` is None if it must be."""

    name: str
    default: str | None
    doc: str = ""


@dataclass(frozen=True, slots=True)
class LaunchFile:
    """Content of a launch file: its arguments, and the topics that it remaps to, which nobody can change."""

    arguments: tuple[LaunchArgument, ...]
    fixed_topics: tuple[str, ...]


def read_launch(text: str) -> LaunchFile:
    """Read a launch file; what is commented out does not count."""
    arguments: dict[str, LaunchArgument] = {}
    topics: dict[str, None] = {}
    for tag in _TAG.finditer(without_comments(text)):
        found = {name: double or single for name, double, single in _ATTRIBUTE.findall(tag[2])}
        if tag[1] == "arg" and found.get("name") and "value" not in found:
            arguments[found["name"]] = LaunchArgument(found["name"], found.get("default"), found.get("doc", ""))
        elif tag[1] == "remap" and found.get("to") and "$(" not in found["to"]:
            topics[found["to"]] = None
    return LaunchFile(tuple(arguments.values()), tuple(topics))


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


# The placeholders of ``template.yaml``, which published scripts fill with ``string.Template``.


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
