"""Reading the file that :mod:`slamhive.services.versions.exporting` wrote. Nothing in it is trusted."""

from __future__ import annotations

import json
import tarfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from slamhive.catalogue.algorithm_file import ALGORITHM_FILE, load_algorithms, package_hash
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.domain.names import check_name
from slamhive.errors import Conflict, InvalidInput, SlamHiveError, Unavailable
from slamhive.executors.base import Executor
from slamhive.files import temporary_folder
from slamhive.services.versions.exporting import (
    BLOCK_BYTES,
    DESCRIPTION,
    FORMAT,
    KIND,
    MANIFEST,
    PACKAGE,
    HashedReader,
)
from slamhive.services.versions.keeping import copy_package

_MOST_PACKAGE_BYTES = 500_000_000
_MOST_TEXT_BYTES = 20_000_000
_REMEDY = "export the version again"


@dataclass(frozen=True, slots=True)
class ImportedVersion:
    """A version that was imported: its package in the project, its image, and whether the package was new here."""

    package: AlgorithmPackage
    identity: str
    package_hash: str
    version: str
    added: bool


@dataclass(frozen=True, slots=True)
class PackedVersion:
    """A version in an archive that was checked: its package, unpacked for a while, and whether it has its image."""

    package: AlgorithmPackage
    identity: str
    package_hash: str
    has_image: bool


@contextmanager
def opened_version(path: Path, root: Path | None = None) -> Iterator[PackedVersion]:
    """Check the archive of a version, and unpack its package for the block, below ``root``. Nothing is executed.

    Raises InvalidInput if it is damaged, or none of ours; Unavailable if the disk refuses.
    """
    with temporary_folder(root=root) as aside:
        try:
            description = _unpack_checked(path, aside)
        except (tarfile.TarError, OSError, EOFError) as error:
            raise InvalidInput(f"{path} cannot be read: {error}", _REMEDY) from None
        source = aside / "package"
        _check_package(path, source, description)
        yield PackedVersion(
            load_algorithms(source)[0].package,
            str(description["identity"]),
            str(description["package_hash"]),
            description.get("image") is not False,
        )


def is_export(path: Path) -> bool:
    """Whether ``path`` is an archive of ours, and not one that ``docker save`` alone has written."""
    try:
        with tarfile.open(path, mode="r|*") as archive:
            first = archive.next()
            return first is not None and first.name == DESCRIPTION
    except (tarfile.TarError, OSError, EOFError):
        return False


def import_version(path: Path, folders: Sequence[Path], executor: Executor) -> ImportedVersion:
    """Load the image of an exported version; add the package to the last of ``folders`` if none has one of its name.

    Everything is checked first: a damaged archive changes nothing.

    Raises:
        InvalidInput: It is damaged, or none of ours, or the engine has loaded another image than it names.
        Conflict: A folder of the package is here that is not the one of the archive.
        Unavailable: The disk or the engine refuses.
    """
    with opened_version(path) as packed:
        name = packed.package.name
        if not packed.has_image:
            raise InvalidInput(f"{path} holds the package {name} without an image", "build it")
        targets = [folder / name for folder in folders]
        target = next((entry for entry in targets if entry.exists()), targets[-1])
        added = not target.exists()
        if not added and package_hash(target) != packed.package_hash:
            raise Conflict(f"{target} is another package than that of {path}", "move the folder away, then import")
        identity = executor.load_image(_chunks(path))
        if identity != packed.identity:
            raise InvalidInput(f"{path} holds image {identity[:19]}, not {packed.identity[:19]}", _REMEDY)
        if added:
            copy_package(packed.package.folder, target)
    package = load_algorithms(target)[0].package
    return ImportedVersion(package, identity, packed.package_hash, package.version, added)


def _unpack_checked(path: Path, aside: Path) -> dict[str, Any]:
    """Compare all checksums, and unpack the package; the description."""
    found: dict[str, str] = {}
    texts: dict[str, bytes] = {}
    unpacked = 0
    with tarfile.open(path, mode="r|*") as archive:
        for member in archive:
            content = archive.extractfile(member) if member.isreg() else None
            if content is None:
                continue
            hashed = HashedReader(content)
            if member.name in (DESCRIPTION, MANIFEST):
                texts[member.name] = hashed.read(_MOST_TEXT_BYTES)
            elif member.name.startswith(PACKAGE):
                unpacked += member.size
                _check_size(path, unpacked)
                _write(aside / "package" / _relative(path, member.name), hashed)
            while hashed.read(BLOCK_BYTES):
                pass
            found[member.name] = hashed.checksum
    if MANIFEST not in texts or DESCRIPTION not in texts:
        raise InvalidInput(f"{path} is not complete: it lacks {MANIFEST}", _REMEDY)
    found.pop(MANIFEST)
    if found != dict(_manifest(texts[MANIFEST])):
        raise InvalidInput(f"{path} is damaged: its content does not have the checksums of {MANIFEST}", _REMEDY)
    return _description(path, texts[DESCRIPTION])


def _check_size(path: Path, unpacked: int) -> None:
    if unpacked > _MOST_PACKAGE_BYTES:
        raise InvalidInput(f"the package in {path} is larger than {_MOST_PACKAGE_BYTES // 1_000_000} MB")


def _relative(path: Path, name: str) -> PurePosixPath:
    inside = PurePosixPath(name.removeprefix(PACKAGE))
    if inside.is_absolute() or ".." in inside.parts or not inside.parts:
        raise InvalidInput(f"{path} holds the file name {name!r}, which leaves its folder")
    return inside


def _write(target: Path, content: HashedReader) -> None:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("wb") as stream:
            while block := content.read(BLOCK_BYTES):
                stream.write(block)
    except OSError as error:
        raise Unavailable(f"{target} cannot be written: {error.strerror}", "check space and rights") from None


def _manifest(text: bytes) -> Iterator[tuple[str, str]]:
    for line in text.decode(errors="replace").splitlines():
        checksum, _, name = line.partition("  ")
        yield name, checksum


def _description(path: Path, text: bytes) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except ValueError:
        content = None
    keys = ("package", "version", "identity", "package_hash")
    if not isinstance(content, dict) or content.get("kind") != KIND or not all(key in content for key in keys):
        raise InvalidInput(f"{DESCRIPTION} in {path} describes no version", _REMEDY)
    if content.get("format") != FORMAT:
        raise InvalidInput(f"{path} has format {content.get('format')!r}, this version reads {FORMAT}")
    check_name("package", str(content["package"]))
    return content


def _check_package(path: Path, source: Path, description: dict[str, Any]) -> None:
    if not (source / ALGORITHM_FILE).is_file() or package_hash(source) != description["package_hash"]:
        raise InvalidInput(f"the package in {path} is not the one that its version names", _REMEDY)
    try:
        named = load_algorithms(source)[0].package.name
    except SlamHiveError as error:
        raise InvalidInput(f"the package in {path} cannot be used: {error.message}", error.remedy) from None
    if named != description["package"]:
        raise InvalidInput(f"the package in {path} is called {named}, not {description['package']}", _REMEDY)


def _chunks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as stream:
        while chunk := stream.read(BLOCK_BYTES):
            yield chunk
