"""Packages that import their modules only when one of their names is used."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any


def lazy_names(package: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package that has its imports under ``if TYPE_CHECKING:`` alone.

    A name is imported from its module on first use. A package costs nothing until then, and type checkers and
    import-linter still see every import.
    """
    module = sys.modules[package]

    @cache
    def origins() -> dict[str, str]:
        """{name: module} of all imports below ``if TYPE_CHECKING:``."""
        blocks = [node for node in ast.parse(Path(str(module.__file__)).read_bytes()).body if isinstance(node, ast.If)]
        imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
        return {alias.name: str(node.module) for node in imports for alias in node.names}

    def load(name: str) -> Any:
        if name.startswith("__") or name not in origins():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(origins()[name]), name)
        setattr(module, name, value)
        return value

    return load
