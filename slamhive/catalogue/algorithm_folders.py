"""Algorithms that other packages carry, in the entry-point group ``slamhive.algorithms``.

An entry point names a Python package whose folder is the algorithm's: it holds ``algorithm.yaml`` and what
``docs/container-contract.md`` asks for. The entry point has the name that ``algorithm.yaml`` gives to the package.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from slamhive.catalogue.algorithm_file import ALGORITHM_FILE
from slamhive.domain.names import check_name
from slamhive.errors import InvalidInput
from slamhive.registry import Registry


def _read(name: str, found: Any) -> Mapping[str, Path]:
    if isinstance(found, ModuleType) and found.__file__:
        found = Path(found.__file__).parent
    if not isinstance(found, Path):
        raise InvalidInput(f"it is neither a Python package nor a Path, but of type {type(found).__name__}")
    if not (found / ALGORITHM_FILE).is_file():
        raise InvalidInput(f"{found} holds no {ALGORITHM_FILE}", "list it under package-data in pyproject.toml")
    return {check_name("algorithm package", name): found}


ALGORITHM_FOLDERS: Registry[Path] = Registry("algorithm", "slamhive.algorithms", _read)
