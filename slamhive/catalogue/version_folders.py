"""Packages as they were: ``<data>/versions/<package>/<number>/`` holds the folder of each version."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from slamhive.catalogue.algorithm_file import ALGORITHM_FILE, load_algorithms
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.versions import version_label
from slamhive.errors import NotFound, SlamHiveError


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
