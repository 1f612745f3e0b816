"""Algorithms that other packages carry, in the entry-point group ``slamhive.algorithms``.

An entry point names a Python package whose folder is the algorithm's: it holds ``algorithm.yaml`` and what
``docs/container-contract.md`` asks for. The entry point has the name that ``algorithm.yaml`` gives to the package.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.base.registry import Registry
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.names import check_name
from slamhive.domain.packages import version_label
from slamhive.packages.algorithm_file import ALGORITHM_FILE, load_algorithms


def _read(name: str, found: Any) -> Mapping[str, Path]:
    if isinstance(found, ModuleType) and found.__file__:
        found = Path(found.__file__).parent
    if not isinstance(found, Path):
        raise InvalidInput(f"it is neither a Python package nor a Path, but of type {type(found).__name__}")
    if not (found / ALGORITHM_FILE).is_file():
        raise InvalidInput(f"{found} holds no {ALGORITHM_FILE}", "list it under package-data in pyproject.toml")
    return {check_name("algorithm package", name): found}


ALGORITHM_FOLDERS: Registry[Path] = Registry("algorithm", "slamhive.algorithms", _read)


# Packages as they were: ``<data>/versions/<package>/<number>/`` holds the folder of each version.


def version_folder(root: Path, package: str, number: int) -> Path:
    """Where the folder of a version is kept."""
    return root / package / str(number)


def kept_algorithms(root: Path) -> Iterator[Algorithm]:
    """The algorithms of all versions whose folders are kept. A folder that cannot be read is left out."""
    for path in sorted(root.glob(f"*/*/{ALGORITHM_FILE}")):
        if path.parent.name.isdecimal():
            try:
                yield from _of_folder(path.parent)
            except SlamHiveError:
                continue


def kept_algorithm(root: Path, name: str, number: int) -> Algorithm:
    """The algorithm ``name`` as it was in version ``number`` of its package; raises NotFound or InvalidInput."""
    for path in sorted(root.glob(f"*/{number}/{ALGORITHM_FILE}")):
        for algorithm in _of_folder(path.parent):
            if algorithm.name == name:
                return algorithm
    known = sorted(entry.version or 0 for entry in kept_algorithms(root) if entry.name == name)
    listed = f"kept are {', '.join(map(str, known))}" if known else "no version of it is kept"
    raise NotFound(f"there is no folder of version {version_label(name, number)}", f"{listed}; {name} is the newest")


def _of_folder(folder: Path) -> tuple[Algorithm, ...]:
    return tuple(replace(algorithm, version=int(folder.name)) for algorithm in load_algorithms(folder))
