"""What is kept of a version: its image or environment, and the folder of the package as it was."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from slamhive.catalogue.version_folders import version_folder
from slamhive.domain.algorithm import Algorithm, AlgorithmPackage
from slamhive.errors import NotFound, Unavailable
from slamhive.executors.base import EngineUnavailable, Executor, ImageMissing
from slamhive.files import remedy_of, temporary_folder
from slamhive.store import Store, VersionRecord

_LEFT_OUT = shutil.ignore_patterns("__pycache__")


def keep_version(root: Path, executor: Executor, package: AlgorithmPackage, identity: str, number: int) -> None:
    """Keep the image of a version under a name of its own, and the folder. Nothing that is there changes.

    Args:
        root: The folder of all versions.
        executor: Has the image or environment.
        package: The package as it is now.
        identity: What a run of it uses.
        number: Of the version.

    Raises Unavailable if the disk refuses, ImageMissing if the image is gone.
    """
    executor.keep(package, identity, number)
    target = version_folder(root, package.name, number)
    if not target.is_dir():
        copy_package(package.folder, target)


def copy_package(source: Path, target: Path) -> None:
    """Copy a package to a folder that does not exist, in one step. Raises Unavailable."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(".version-", target.parent) as aside:
            shutil.copytree(source, aside / "package", ignore=_LEFT_OUT)
            (aside / "package").rename(target)
    except OSError as error:
        if not target.is_dir():
            raise Unavailable(f"{target} cannot be written: {error.strerror or error}", remedy_of(error)) from None


def find_version(store: Store, package: str, number: int) -> VersionRecord:
    """Version ``number`` of ``package``; raises NotFound that lists the known ones."""
    known = store.read(lambda t: t.versions.of(package))
    for record in known:
        if record.number == number:
            return record
    listed = ", ".join(record.label for record in known) or f"none of {package}"
    raise NotFound(f"there is no version {number} of {package}", f"known are {listed}")


def identity_of_version(store: Store, executor: Executor, algorithm: Algorithm) -> str:
    """The image or environment of ``algorithm`` in the version that it names; raises NotFound or ImageMissing."""
    record = find_version(store, algorithm.package.name, algorithm.version or 0)
    if not executor.has(algorithm.package, record.identity):
        raise ImageMissing(
            f"{record.label} cannot run on {executor.name}: {record.identity[:19]} is not there",
            f"import it (slamhive algorithm import), or use the newest version: {algorithm.name}",
        )
    return record.identity


def check_version(store: Store, executor: Executor, algorithm: Algorithm) -> None:
    """Raise NotFound or ImageMissing if ``algorithm`` names a version that cannot run.

    An engine that does not answer now is asked by the worker later.
    """
    if algorithm.version is not None:
        with contextlib.suppress(EngineUnavailable):
            identity_of_version(store, executor, algorithm)
