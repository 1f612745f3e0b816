"""The versions of packages: listed, verified, removed, exported and imported."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError, unknown
from slamhive.base.settings import Mode, Settings
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.domain.packages import split_version
from slamhive.executors.base import Executor, ImageMissing, PackageNeed
from slamhive.packages.algorithm_file import load_algorithms, package_hash, version_folder
from slamhive.services.datasets import Catalogue, check_writable
from slamhive.services.executors import Executors
from slamhive.services.versions.exchange import (
    ImportedVersion,
    export_version,
    find_version,
    import_version,
    keep_version,
)
from slamhive.store import AlgorithmVersion, Store, VersionRecord


@dataclass(frozen=True, slots=True)
class VersionFinding:
    """Something about a version that is not as it was: a short ``kind``, and what was found in words."""

    version: str
    kind: str
    words: str


@dataclass(frozen=True, slots=True)
class VersionReport:
    """A version with what is here of it: executors that can run it, and whether its folder is kept."""

    record: VersionRecord
    runs_on: tuple[str, ...]
    kept: bool


class Versions:
    """The versions of one installation.

    Args:
        settings: Mode and data root.
        store: Knows the versions.
        catalogue: The packages as they are now.
        executors: Have the images and environments.
    """

    def __init__(self, settings: Settings, store: Store, catalogue: Catalogue, executors: Executors) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue
        self._executors = executors

    def register(self, executor: Executor, package: AlgorithmPackage, identity: str) -> VersionRecord:
        """Number a version that was just built, and keep it; one that is known keeps its number."""
        version = AlgorithmVersion(identity, package_hash(package.folder), package.version)
        _, number = self._store.write(lambda t: t.versions.put(package.name, version, utc_now()))
        keep_version(self._settings.versions_folder, executor, package, identity, number)
        return find_version(self._store, package.name, number)

    def of(self, package: str) -> tuple[VersionRecord, ...]:
        """The versions of a package, the oldest first, with their number of runs."""
        return self._store.read(lambda t: t.versions.of(package))

    def labels(self) -> list[str]:
        """List the names of the versions that have not been removed."""
        records = self._store.read(lambda t: t.versions.all())
        return [record.label for record in records if record.removed_at is None]

    def reports(self, package: str) -> tuple[VersionReport, ...]:
        """The versions of a package with what is here of them. Executors that do not answer are left out.

        In view-only mode none is asked: asking may make files in the data root.
        """
        executors = [] if self._settings.mode is Mode.VIEW_ONLY else self._executors.usable()
        return tuple(
            VersionReport(
                record,
                tuple(executor.name for executor in executors if self._has(executor, record)),
                self._folder(record).is_dir(),
            )
            for record in self.of(self.package_of(package))
        )

    def package_of(self, name: str) -> str:
        """The package called ``name``, or that of the algorithm; its folder may be gone. Raises NotFound."""
        known = {record.package for record in self._store.read(lambda t: t.versions.all())}
        if name in known:
            return name
        modes = {entry.name: entry.package for entry in self._store.read(lambda t: t.catalogue.algorithms())}
        if name in modes:
            return modes[name]
        try:
            return self._catalogue.package(name).name
        except NotFound:
            raise unknown("algorithm or package", name, sorted({*known, *modes})) from None

    def find(self, text: str) -> VersionRecord:
        """The version that ``NAME@NUMBER`` names, or the newest one of ``NAME``; raises NotFound or InvalidInput."""
        name, number = split_version(text)
        package = self.package_of(name)
        if number is not None:
            return find_version(self._store, package, number)
        known = [record for record in self.of(package) if record.removed_at is None]
        if not known:
            raise NotFound(f"{package} has no version yet", f"slamhive algorithm build {package} makes one")
        return known[-1]

    # -- verifying -------------------------------------------------------------------------------------------------

    def verify(self, name: str | None = None) -> list[VersionFinding]:
        """Report what has changed or vanished: images, environments, kept folders, and the packages themselves."""
        wanted = None if name is None else self.package_of(name)
        records = self._store.read(lambda t: t.versions.all())
        findings = []
        executors = self._executors.usable()
        for package in sorted({record.package for record in records if wanted in (None, record.package)}):
            versions = [record for record in records if record.package == package and record.removed_at is None]
            for record in versions:
                if not any(self._has(executor, record) for executor in executors):
                    asked = ", ".join(executor.name for executor in executors) or "no executor"
                    words = f"{record.identity[:19]} is gone ({asked} asked); {record.runs} runs used it"
                    findings.append(VersionFinding(record.label, "missing", words))
                folder = self._folder(record)
                if folder.is_dir() and package_hash(folder) != record.package_hash:
                    findings.append(VersionFinding(record.label, "edited", f"the kept folder {folder} was changed"))
            try:
                here = self._catalogue.package(package)
            except SlamHiveError as error:
                words = f"the folder of the package cannot be used: {error.message}"
                findings.append(VersionFinding(package, "no folder", words))
                continue
            if versions and package_hash(here.folder) not in {record.package_hash for record in versions}:
                built = f"{versions[-1].label} was built; the next run makes a new version"
                words = f"{here.folder} was edited since {built}"
                findings.append(VersionFinding(package, "folder edited", words))
            known = {record.identity for record in versions}
            for executor in executors:
                found = executor.named_image(here)
                if found is not None and found not in known:
                    words = f"{here.image} names {found[:19]} on {executor.name}, which is no known version"
                    findings.append(VersionFinding(package, "tag moved", words))
        return findings

    # -- removing --------------------------------------------------------------------------------------------------

    def remove(self, text: str, *, with_runs: bool = False) -> VersionRecord:
        """Remove image, environment and folder of a version; its number and its runs stay.

        Raises Conflict if runs used it, unless ``with_runs``.
        """
        check_writable(self._settings)
        if split_version(text)[1] is None:
            raise InvalidInput(f"{text!r} names no version", "write NAME@NUMBER")
        record = self.find(text)
        if record.runs and not with_runs:
            raise Conflict(
                f"{record.runs} runs used {record.label}: without it they cannot be repeated", "give --with-runs"
            )
        for executor in self._executors.usable():
            if self._has(executor, record):
                executor.forget(record.package, record.identity, record.number)
        shutil.rmtree(self._folder(record), ignore_errors=True)
        self._store.write(lambda t: t.versions.mark_removed(record.package, record.number, utc_now()))
        return record

    def unused(self, name: str | None = None) -> list[VersionRecord]:
        """The versions that no run used, apart from the newest of each package."""
        wanted = None if name is None else self.package_of(name)
        records = [
            record
            for record in self._store.read(lambda t: t.versions.all())
            if record.removed_at is None and wanted in (None, record.package)
        ]
        newest = {record.package: record.number for record in records}
        return [record for record in records if not record.runs and record.number != newest[record.package]]

    # -- moving ----------------------------------------------------------------------------------------------------

    def export(self, text: str, path: Path, executor: Executor) -> VersionRecord:
        """Write the archive of a version; raises NotFound, ImageMissing, Conflict or Unavailable."""
        record = self.find(text)
        folder = self._folder(record)
        if not folder.is_dir():
            raise InvalidInput(f"the folder of {record.label} was not kept", "export a newer version")
        if package_hash(folder) != record.package_hash:
            raise InvalidInput(f"the kept folder {folder} was changed", "export a newer version")
        image = executor.save_image(record.identity)
        if not self._has(executor, record):
            raise ImageMissing(f"the image of {record.label} is gone", "slamhive algorithm verify lists all of them")
        export_version(record, folder, image, path)
        return record

    def pack(self, record: VersionRecord, path: Path, *, image: bool) -> bool:
        """Write package, and with ``image`` the image, of a version for an archive of runs; whether the image is in it.

        An environment of a process is no image: it is built from the package. Raises InvalidInput if the folder of the
        package is gone, ImageMissing if the image is.
        """
        package = self.package_with(record.package, record.package_hash)
        if package is None:
            raise InvalidInput(f"the folder of {record.label} was not kept", "leave out --with packages and images")
        executors = (
            [entry for entry in self._executors.usable() if entry.has(package, record.identity)] if image else []
        )
        executor = next((entry for entry in executors if entry.capabilities.needs is PackageNeed.IMAGE), None)
        if image and not executors:
            raise ImageMissing(f"the image of {record.label} is gone", "give --with packages in place of images")
        export_version(record, package.folder, None if executor is None else executor.save_image(record.identity), path)
        return executor is not None

    def package_with(self, name: str, content_hash: str) -> AlgorithmPackage | None:
        """The package ``name`` with exactly these files: a kept folder, or that of the project; None if it is gone."""
        for record in self.of(name):
            folder = self._folder(record)
            if record.package_hash == content_hash and folder.is_dir() and package_hash(folder) == content_hash:
                return load_algorithms(folder)[0].package
        try:
            package = self._catalogue.package(name)
        except SlamHiveError:
            return None
        return package if package_hash(package.folder) == content_hash else None

    def load(self, path: Path, executor: Executor) -> tuple[ImportedVersion, VersionRecord]:
        """Import the archive that :meth:`export` wrote; what it holds, and the version that it is here."""
        check_writable(self._settings)
        folders = (self._catalogue.project_root / "algorithms", self._settings.algorithms_folder)
        imported = import_version(path, folders, executor)
        return imported, self.register(executor, imported.package, imported.identity)

    # -- what is here ----------------------------------------------------------------------------------------------

    def _folder(self, record: VersionRecord) -> Path:
        return version_folder(self._settings.versions_folder, record.package, record.number)

    def _has(self, executor: Executor, record: VersionRecord) -> bool:
        folder = self._folder(record)
        try:
            package = load_algorithms(folder)[0].package if folder.is_dir() else self._catalogue.package(record.package)
        except SlamHiveError:
            package = AlgorithmPackage(record.package, folder, record.package, record.version, "", "", "")
        try:
            return executor.has(package, record.identity)
        except ImageMissing:
            return False
