"""The weights of packages: added or downloaded once, checked by checksum, mounted read-only into runs.

They lie in ``<data>/weights/<package>``. Where no checksum is published, the one of the file that was added first is
kept beside it (``<name>.sha256``), so that all runs use the same weights.
"""

from __future__ import annotations

import hashlib
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from slamhive.base.errors import InvalidInput, NotFound, Unavailable
from slamhive.base.files import remedy_of, write_aside
from slamhive.base.settings import Settings
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.domain.collection import FileKind, RemoteFile
from slamhive.domain.packages import Weights
from slamhive.downloads.download import Pace, Received, download
from slamhive.services.datasets import check_writable

WEIGHTS = "weights"
"""Their folder in a data root."""
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class StoredWeights:
    """Weights with their place in the data root. ``sha256`` is what the file must have; None if nothing is known."""

    weights: Weights
    path: Path
    sha256: str | None

    @property
    def present(self) -> bool:
        """Tell if the file is there; it is not checked."""
        return self.path.is_file()


class WeightsStore:
    """The weights of one data root."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._folder = settings.data / WEIGHTS

    def stored(self, package: AlgorithmPackage) -> tuple[StoredWeights, ...]:
        """All weights of the package, present or not."""
        found = []
        for weights in package.weights:
            path = self._folder / package.name / weights.name
            checksum, note = weights.sha256, _note_of(path)
            if not checksum:
                try:
                    checksum = note.read_text(encoding="ascii").strip()
                except FileNotFoundError:
                    checksum = None
                except (OSError, UnicodeDecodeError):
                    checksum = ""
                if checksum is not None and not _SHA256.fullmatch(checksum):
                    remedy = "remove it and the weights, and add them again"
                    raise InvalidInput(f"{note} holds no checksum", remedy)
            found.append(StoredWeights(weights, path, checksum))
        return tuple(found)

    def check_present(self, package: AlgorithmPackage) -> None:
        """Raise InvalidInput, with the command, if weights are missing. Quick."""
        for entry in self.stored(package):
            if not entry.present:
                raise InvalidInput(
                    f"{package.name} needs the weights {entry.weights.name}, which are not here",
                    f"see {entry.weights.page}, then: slamhive algorithm weights {package.name} --file FILE",
                )

    def checked(self, package: AlgorithmPackage) -> tuple[StoredWeights, ...]:
        """All weights of the package; raises InvalidInput if one is missing or differs from its checksum."""
        self.check_present(package)
        entries = self.stored(package)
        for entry in entries:
            _check(entry, entry.path, _sha256_of(entry.path))
        return entries

    def add(self, package: AlgorithmPackage, source: Path, name: str | None = None) -> StoredWeights:
        """Copy ``source`` to the data root as the weights ``name``, by default those of the same name.

        Raises NotFound, or InvalidInput if the checksum differs; nothing is kept then.
        """
        check_writable(self._settings)
        entry = self._entry(package, name or source.name)
        if not source.is_file():
            raise NotFound(f"{source} is not a file")
        digest = _sha256_of(source)
        _check(entry, source, digest)
        aside = entry.path.with_name(f".{entry.path.name}")
        try:
            entry.path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, aside)
            aside.replace(entry.path)
        except OSError as error:
            aside.unlink(missing_ok=True)
            raise Unavailable(f"{entry.path} cannot be written: {error.strerror}", remedy_of(error)) from None
        return self._note(entry, digest)

    def fetch(self, package: AlgorithmPackage, received: Received) -> tuple[StoredWeights, ...]:
        """Download what is missing. Raises InvalidInput for weights that have no address."""
        check_writable(self._settings)
        for entry in self.stored(package):
            if entry.present:
                continue
            weights = entry.weights
            if weights.address is None:
                raise InvalidInput(
                    f"{weights.name} cannot be downloaded by a program",
                    f"take it from {weights.page}, then: slamhive algorithm weights {package.name} --file FILE",
                )
            checksum = None if entry.sha256 is None else f"sha256:{entry.sha256}"
            file = RemoteFile(
                weights.name, (weights.address,), FileKind.PLAIN, size_bytes=weights.size_bytes, checksum=checksum
            )
            entry.path.parent.mkdir(parents=True, exist_ok=True)
            download(file, entry.path, Pace(), received=received)
            self._note(entry, _sha256_of(entry.path))
        return self.stored(package)

    def _entry(self, package: AlgorithmPackage, name: str) -> StoredWeights:
        entries = {entry.weights.name: entry for entry in self.stored(package)}
        if name not in entries:
            known = ", ".join(entries) or "none"
            raise NotFound(f"{package.name} has no weights {name!r}", f"known: {known}; name the file with --as")
        return entries[name]

    def _note(self, entry: StoredWeights, digest: str) -> StoredWeights:
        if entry.sha256 is None:
            write_aside(_note_of(entry.path), f"{digest}\n")
        return StoredWeights(entry.weights, entry.path, digest)


def _check(entry: StoredWeights, path: Path, found: str) -> None:
    if entry.sha256 is not None and found != entry.sha256:
        raise InvalidInput(
            f"{path} is not what the weights {entry.weights.name} were: SHA-256 {found}, expected {entry.sha256}",
            f"use the file that {entry.weights.page} publishes",
        )


def _note_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")


def _sha256_of(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise Unavailable(f"{path} cannot be read: {error.strerror}", remedy_of(error)) from None
