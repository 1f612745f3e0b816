"""Finds the English in a file: Markdown, a Jinja template, Python (messages, docstrings, comments) or YAML.

What is no English (code, markup, addresses) becomes a placeholder, so that the words around it stay a sentence.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

CODE = "CODE"
_FENCE = re.compile(r"^ {0,8}(`{3,}|~{3,})")
_BLOCK_START = re.compile(r"^\s*(?:[-*+]|\d+\.|:|>|#+|!!!|===)\s+")
_RULED_LINE = re.compile(r"^[\s|:=-]+$")
_DOCSTRING_START = re.compile(_BLOCK_START.pattern + r"|^\s*(?:Args|Returns|Raises|Yields):|^\s+\**\w+:\s")
_ARGUMENT_NAME = re.compile(r"^\**\w+: ")
_HTML_BLOCKS = re.compile(r"</?(?!(?:a|b|i|em|strong|span|abbr|time|small|code|kbd|var)\b)[a-z][^>]*>", re.IGNORECASE)
_HTML_CODE = re.compile(r"<(code|pre|script|style|kbd|svg)\b.*?</\1>", re.DOTALL | re.IGNORECASE)
_SPOKEN_ATTRIBUTE = re.compile(r'\b(?:title|alt|placeholder|aria-label)="([^"]*)"')
_JINJA_BLOCK = re.compile(r"\{[{%].*?[}%]\}", re.DOTALL)
_JINJA_STRING = re.compile(r"'((?:[^'\\]|\\.)*)'")
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*\b")
_SETTING = re.compile(r"[A-Z_]+ = \S+\s*")
_YAML_TEXTS = frozenset({"title", "help", "description", "note"})
_NOQA = re.compile(r"\b(?:noqa|type: ignore|pragma|mypy:).*")


@dataclass(frozen=True)
class Passage:
    """A piece of English: a paragraph, a cell of a table, a message. ``line`` is where it begins, from 1."""

    line: int
    text: str


def passages(path: Path) -> list[Passage]:
    """All English in a file, by its suffix."""
    text = path.read_text(encoding="utf-8")
    readers = {".md": markdown, ".html": template, ".py": python, ".yaml": yaml_texts}
    return [entry for entry in readers[path.suffix](text) if re.search(r"[A-Za-z]{2}", entry.text)]


def markdown(text: str, block_start: re.Pattern[str] = _BLOCK_START) -> Iterator[Passage]:
    """Paragraphs, items and cells; fenced and indented code left out."""
    block: list[str] = []
    start, fence = 0, ""
    for number, line in enumerate(text.splitlines(), 1):
        mark = _FENCE.match(line)
        if fence:
            fence = "" if mark and mark[1].startswith(fence) else fence
            continue
        if mark or not line.strip() or block_start.match(line) or line.lstrip().startswith("|"):
            yield from _block(block, start)
            block = []
        if mark:
            fence = mark[1]
        elif line.lstrip().startswith("|"):
            yield from _cells(line, number)
        elif line.strip():
            start = start if block else number
            block.append(line)
    yield from _block(block, start)


def _block(lines: list[str], start: int) -> Iterator[Passage]:
    if lines:
        joined = " ".join(_BLOCK_START.sub("", line).strip() for line in lines)
        yield Passage(start, plain(joined))


def _cells(row: str, number: int) -> Iterator[Passage]:
    if not _RULED_LINE.match(row):
        for cell in plain(row.replace(r"\|", "/")).strip().strip("|").split("|"):
            yield Passage(number, cell.strip())


def plain(text: str) -> str:
    """A text without its markup: code becomes a placeholder, a link its words."""
    text = re.sub(r"``.+?``|`[^`]+`", CODE, text)
    text = re.sub(r":\w+:CODE", CODE, text)
    text = re.sub(r"<(https?:[^>]*)>", CODE, text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"</?[a-zA-Z][^>]*>|\*\*", "", text)
    text = _OPTION.sub(CODE, text)
    return re.sub(r"\bhttps?://\S+", CODE, text)


def template(text: str) -> Iterator[Passage]:
    """The text between tags, the attributes that are read out, and strings in expressions."""
    for found in _SPOKEN_ATTRIBUTE.finditer(text):
        yield Passage(_line(text, found.start()), plain(_JINJA_BLOCK.sub(CODE, found[1])))
    for block in _JINJA_BLOCK.finditer(text):
        for found in _JINJA_STRING.finditer(block[0]):
            if " " in found[1]:
                yield Passage(_line(text, block.start()), plain(found[1]))
    text = _JINJA_BLOCK.sub(lambda found: (CODE if found[0][1] == "{" else "\0") + "\n" * found[0].count("\n"), text)
    text = _blank(re.compile(r"\{#|#\}"), text, "\0")
    text = _blank(_HTML_CODE, text, CODE)
    text = _blank(_HTML_BLOCKS, text, "\0")
    text = _blank(re.compile(r"<[^>]*>|&\w+;"), text, " ")
    for found in re.finditer(r"[^\0]+", text):
        yield Passage(_line(text, found.start()), found[0])


def _blank(pattern: re.Pattern[str], text: str, mark: str) -> str:
    """Replace what matches, keeping the lines."""
    return pattern.sub(lambda found: mark + "\n" * found[0].count("\n"), text)


def _line(text: str, position: int) -> int:
    return text.count("\n", 0, position) + 1


def python(text: str) -> Iterator[Passage]:
    """Docstrings, messages (strings of several words) and comments."""
    tree = ast.parse(text)
    read: set[ast.AST] = set()
    for node in ast.walk(tree):
        for constant, found in _bare_strings(node):
            read.add(constant)
            yield from docstring(found, constant.lineno)
        if isinstance(node, ast.JoinedStr):
            read.update(node.values)
            yield from _message("".join(map(_piece, node.values)), node.lineno)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in read:
            yield from _message(node.value, node.lineno)
    yield from comments(text)


def _bare_strings(node: ast.AST) -> Iterator[tuple[ast.Constant, str]]:
    """The docstrings of a module, class or function, and those below attributes."""
    body = getattr(node, "body", [])
    for statement in body if isinstance(body, list) else []:
        if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
            constant = statement.value
            if isinstance(constant.value, str):
                yield constant, constant.value


def opening_words(text: str) -> Iterator[Passage]:
    """The first word of each docstring of a module, a class or a function."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            words = (ast.get_docstring(node) or "").split(maxsplit=1)
            if words:
                yield Passage(node.body[0].lineno, words[0])


def _piece(node: ast.expr) -> str:
    return str(node.value) if isinstance(node, ast.Constant) else CODE


def _message(text: str, line: int) -> Iterator[Passage]:
    """A string that people read: it has a space between words, and is no SQL, markup, path or pattern."""
    if re.search(r"[a-z]{2}[,;:.]? [a-z]{2}", text) and not re.search(r"[{}<>\\^$]|\n\s*\n|SELECT|WHERE|://|=\S", text):
        yield Passage(line, plain(text))


def docstring(text: str, line: int) -> Iterator[Passage]:
    """The paragraphs of a docstring; each argument is one."""
    for passage in markdown(text, _DOCSTRING_START):
        yield Passage(line + passage.line - 1, _ARGUMENT_NAME.sub("", passage.text))


def comments(text: str) -> Iterator[Passage]:
    """Comments; those on consecutive lines are one. A setting that is commented out is by itself."""
    block: list[str] = []
    start = last = 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type != tokenize.COMMENT:
            continue
        words = _NOQA.sub("", token.string.lstrip("#!")).strip()
        if block and (token.start[0] != last + 1 or _SETTING.match(words)):
            yield Passage(start, plain(" ".join(block)))
            block = []
        start = start if block else token.start[0]
        block.append(_SETTING.sub("", words))
        last = token.start[0]
    if block:
        yield Passage(start, plain(" ".join(block)))


def yaml_texts(text: str) -> Iterator[Passage]:
    """The values that users read, such as the help of a parameter."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    pending = [root] if root else []
    while pending:
        node = pending.pop()
        for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
            if key.value in _YAML_TEXTS and isinstance(value, yaml.ScalarNode):
                yield Passage(value.start_mark.line + 1, plain(value.value))
        pending += [child for child in _children(node) if not isinstance(child, yaml.ScalarNode)]


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [value for _, value in node.value]
    return list(node.value)
