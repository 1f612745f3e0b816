"""The versions that a replay needs: exactly those of the record, unless it is allowed to build them again."""

from __future__ import annotations

from pathlib import Path

from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.errors import Conflict, InvalidInput, NotFound, Unavailable
from slamhive.executors.base import Executor, ImageMissing, PackageNeed, ProgressCallback
from slamhive.files import make_shared_folder, remedy_of, temporary_folder
from slamhive.services.algorithms import ImageArchive
from slamhive.services.archive import ArchiveReader, version_member
from slamhive.services.replay.request import ReplayRequest
from slamhive.services.versions import PackedVersion, Versions, opened_version
from slamhive.store import VersionRecord
from slamhive.store.records import AlgorithmVersion

_SHOWN = 19
_LOAD = "give --load-image to take it from the bundle: it is code that will run on this machine"


class Packages:
    """Finds, loads or builds the versions of one bundle.

    Args:
        versions: Of this installation.
        archive: The bundle, verified.
        request: What is allowed.
        folder: Where versions are unpacked for a while.
        progress: Called with lines of builds.
    """

    def __init__(
        self,
        versions: Versions,
        archive: ArchiveReader,
        request: ReplayRequest,
        folder: Path,
        progress: ProgressCallback,
    ) -> None:
        self._versions = versions
        self._archive = archive
        self._request = request
        self._folder = folder
        self._progress = progress

    def get(self, name: str, wanted: AlgorithmVersion, executor: Executor) -> VersionRecord:
        """The version ``wanted`` of package ``name``, which ``executor`` can run then.

        Raises ImageMissing or NotFound if it is not here and must not be loaded or built, Conflict if what was built is
        another image or environment.
        """
        package = self._versions.package_with(name, wanted.package_hash)
        if package is not None and executor.has(package, wanted.identity):
            return self._versions.register(executor, package, wanted.identity)
        member = version_member(name, wanted.identity, wanted.package_hash)
        if self._archive.has(member) and self._request.load_image:
            return self._from_bundle(name, wanted, executor, member)
        if package is None:
            offered = self._archive.has(member)
            raise NotFound(
                f"package {name}, as the recorded runs used it, is not here",
                _LOAD if offered else "ask for a bundle that was exported --with packages or --with images",
            )
        return self._built(package, wanted, executor, offered=self._archive.has(member))

    def _from_bundle(self, name: str, wanted: AlgorithmVersion, executor: Executor, member: str) -> VersionRecord:
        try:
            make_shared_folder(self._folder)
        except OSError as error:
            raise Unavailable(f"{self._folder} cannot be made: {error.strerror}", remedy_of(error)) from None
        with temporary_folder(".version-", self._folder) as aside:
            path = aside / "version.tar"
            self._archive.unpack(member, path)
            with opened_version(path, aside) as packed:
                found = (packed.package.name, packed.identity, packed.package_hash)
                if found != (name, wanted.identity, wanted.package_hash):
                    raise InvalidInput(
                        f"the bundle holds another version of {name} than its runs used", "export it again"
                    )
                if packed.has_image and executor.capabilities.needs is PackageNeed.IMAGE:
                    return self._loaded(packed, path, executor)
                return self._built(packed.package, wanted, executor)

    def _loaded(self, packed: PackedVersion, path: Path, executor: Executor) -> VersionRecord:
        """Load the image without the names that the archive gives it: they could take those of images that are here."""
        image = ImageArchive(path)
        image.check()
        identity = executor.load_image(image.chunks(self._progress))
        if identity != packed.identity:
            raise InvalidInput(
                f"the bundle holds image {identity[:_SHOWN]}, its runs used {packed.identity[:_SHOWN]}",
                "export it again",
            )
        return self._versions.register(executor, packed.package, identity)

    def _built(
        self, package: AlgorithmPackage, wanted: AlgorithmVersion, executor: Executor, *, offered: bool = False
    ) -> VersionRecord:
        """Build the package. The hash of an environment follows from its content; an image is another one each time."""
        rebuild = "--rebuild builds it again from the same files, and the answer says so"
        if executor.capabilities.needs is PackageNeed.IMAGE and not self._request.rebuild:
            raise ImageMissing(
                f"image {wanted.identity[:_SHOWN]} of {package.name} is not here",
                f"{_LOAD}; {rebuild}" if offered else f"ask for a bundle that was exported --with images, or {rebuild}",
            )
        identity = executor.build(package, self._progress)
        if identity != wanted.identity and not self._request.rebuild:
            raise Conflict(
                f"{package.name} ran as {wanted.identity[:_SHOWN]}, here it is built as {identity[:_SHOWN]}",
                rebuild,
            )
        return self._versions.register(executor, package, identity)
