"""One file that moves a version to another machine: what ``docker save`` writes, and a folder ``slamhive`` in it.

The engine ignores the folder, so ``docker load`` takes the file too. ``slamhive/version.json`` describes the version,
``slamhive/package/`` is the folder of the package, and ``slamhive/manifest-sha256.txt``, the last member, holds the
checksum of every other one. The file is written and read as a stream: no image is held in memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import shutil
import tarfile
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any

from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.files import remedy_of, temporary_folder
from slamhive.domain.algorithm import Algorithm, AlgorithmPackage
from slamhive.domain.names import check_name
from slamhive.executors.base import EngineUnavailable, Executor, ImageMissing
from slamhive.packages.algorithm_file import ALGORITHM_FILE, load_algorithms, package_hash, version_folder
from slamhive.store import Store, VersionRecord

FOLDER = "slamhive/"
DESCRIPTION = FOLDER + "version.json"
PACKAGE = FOLDER + "package/"
MANIFEST = FOLDER + "manifest-sha256.txt"
KIND = "slamhive-algorithm"
FORMAT = 1
BLOCK_BYTES = 1 << 20


class ChunkStream(io.RawIOBase):
    """Chunks of bytes as a file to read from."""

    def __init__(self, chunks: Iterable[bytes]) -> None:
        self._chunks = iter(chunks)
        self._rest = b""

    def readable(self) -> bool:
        """It is for reading only."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer as far as one chunk goes; 0 at the end."""
        while not self._rest:
            chunk = next(self._chunks, None)
            if chunk is None:
                return 0
            self._rest = chunk
        count = min(len(buffer), len(self._rest))
        buffer[:count], self._rest = self._rest[:count], self._rest[count:]
        return count


class HashedReader:
    """Reads a member of an archive, and takes its checksum on the way."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._digest = hashlib.sha256()

    def read(self, size: int = -1) -> bytes:
        """The next bytes."""
        data = self._stream.read(size)
        self._digest.update(data)
        return data

    @property
    def checksum(self) -> str:
        """SHA-256 of what was read, in hex."""
        return self._digest.hexdigest()


def export_version(record: VersionRecord, package: Path, image: Iterable[bytes] | None, path: Path) -> None:
    """Write the archive of a version to ``path``, which gets its name when the archive is complete.

    Args:
        record: The version.
        package: The folder of the package as it was.
        image: What the engine saves of the image; None for an archive that holds the package alone.
        path: A file that does not exist; raises Conflict if it does.

    Raises Unavailable if the disk refuses.
    """
    if path.exists():
        raise Conflict(f"{path} exists", "choose another name, or remove it")
    aside = None
    try:
        descriptor, aside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(descriptor, "wb") as stream:
            with tarfile.open(fileobj=stream, mode="w|", format=tarfile.PAX_FORMAT) as archive:
                checksums = dict(_members(archive, record, package, image))
                lines = "".join(f"{checksum}  {name}\n" for name, checksum in checksums.items())
                _add(archive, MANIFEST, lines.encode())
            stream.flush()
            os.fsync(stream.fileno())
            os.fchmod(stream.fileno(), 0o644)
        Path(aside).rename(path)
        aside = None
    except OSError as error:
        raise Unavailable(f"{path} cannot be written: {error.strerror or error}", remedy_of(error)) from None
    finally:
        if aside is not None:
            with contextlib.suppress(OSError):
                Path(aside).unlink()


def _members(
    archive: tarfile.TarFile, record: VersionRecord, package: Path, image: Iterable[bytes] | None
) -> Iterator[tuple[str, str]]:
    """Add all members but the manifest; name and checksum of each file."""
    description = {
        "kind": KIND,
        "format": FORMAT,
        "package": record.package,
        "number": record.number,
        "version": record.version,
        "identity": record.identity,
        "package_hash": record.package_hash,
        "created_at": record.created_at.isoformat(),
        "image": image is not None,
    }
    yield DESCRIPTION, _add(archive, DESCRIPTION, json.dumps(description, indent=1).encode())
    for path in sorted(package.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            name = PACKAGE + path.relative_to(package).as_posix()
            yield name, _add(archive, name, path.read_bytes())
    if image is None:
        return
    with tarfile.open(fileobj=io.BufferedReader(ChunkStream(image), BLOCK_BYTES), mode="r|") as saved:
        for member in saved:
            content = saved.extractfile(member) if member.isreg() else None
            if content is None:
                archive.addfile(member)
                continue
            hashed = HashedReader(content)
            archive.addfile(member, hashed)
            yield member.name, hashed.checksum


def _add(archive: tarfile.TarFile, name: str, content: bytes) -> str:
    member = tarfile.TarInfo(name)
    member.size, member.mode = len(content), 0o644
    archive.addfile(member, io.BytesIO(content))
    return hashlib.sha256(content).hexdigest()


# Kept versions: an image or environment, and the folder of the package as it was.

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


# Reading an exported version. Nothing in it is trusted.

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
            # All checksums are compared while the package is unpacked.
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
            lines = texts[MANIFEST].decode(errors="replace").splitlines()
            stated = {name: checksum for checksum, _, name in (line.partition("  ") for line in lines)}
            if found != stated:
                raise InvalidInput(f"{path} is damaged: its content does not have the checksums of {MANIFEST}", _REMEDY)
            description = _description(path, texts[DESCRIPTION])
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
    """Tell if ``path`` is an archive of ours, and not one that ``docker save`` alone has written."""
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
