"""Compiled modules of Python packages whose own modules need large packages that an image leaves out."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from slamhive.base.errors import InvalidInput


def bare_package(name: str) -> ModuleType:
    """The installed package ``name`` without running its ``__init__``, so that its modules can be imported one by one.

    Raises InvalidInput if it is not installed.
    """
    if name not in sys.modules:
        spec = find_spec(name)
        if spec is None or spec.submodule_search_locations is None:
            raise InvalidInput(f"the Python package {name} is not installed", "build the algorithm again")
        package = ModuleType(name)
        package.__path__ = list(spec.submodule_search_locations)
        sys.modules[name] = package
    return sys.modules[name]


def import_bare(package: str, module: str) -> Any:
    """The module ``package.module``, without running the ``__init__`` of ``package``."""
    bare_package(package)
    return import_module(f"{package}.{module}")
