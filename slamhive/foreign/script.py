"""What a script reads of its configuration, found in its syntax tree. Nothing is imported or executed."""

from __future__ import annotations

import ast
import re
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
class Script:
    """What one Python file says.

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


def read_script(text: str) -> Script:
    """Read Python source; older Python is read by patterns, and says so in ``problem``."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(text)
    except SyntaxError as error:
        return _read_by_patterns(text, f"line {error.lineno or 1}: {error.msg}")
    except (ValueError, RecursionError, MemoryError) as error:
        return _read_by_patterns(text, str(error) or "it is nested too deeply")
    return _read_tree(tree)


def _read_tree(tree: ast.Module) -> Script:
    names: dict[str, None] = {}
    numbers: dict[str, str] = {}
    imports: dict[str, None] = {}
    texts: dict[str, None] = {}
    reads: dict[str, None] = {}
    for node in ast.walk(tree):
        names.update(dict.fromkeys(_keys_of(node)))
        imports.update(dict.fromkeys(_imports_of(node)))
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts[node.value] = None
        if isinstance(node, ast.Call):
            numbers.update(_conversion(node))
            reads.update(dict.fromkeys(_opened(node)))
    return Script(
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


def _imports_of(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name.partition(".")[0] for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
        yield node.module.partition(".")[0]


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


def _read_by_patterns(text: str, problem: str) -> Script:
    names = dict.fromkeys(found[2] for found in _OLD_KEY.finditer(text))
    imports = (part.strip().partition(".")[0] for found in _OLD_IMPORT.finditer(text) for part in found[1].split(","))
    return Script(
        keys=tuple(name for name in names if _KEY.fullmatch(name) and name not in _SECTIONS),
        sections=_SECTIONS & names.keys(),
        imports=tuple(dict.fromkeys(imports)),
        texts=tuple(dict.fromkeys(found[2] for found in _OLD_TEXT.finditer(text))),
        problem=problem,
    )
