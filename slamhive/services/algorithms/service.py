"""Imports and removes algorithm packages of others. They lie in the data root, one folder each."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from slamhive.catalogue.algorithm_file import ALGORITHM_FILE, load_algorithms
from slamhive.clock import utc_now
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.names import check_name
from slamhive.errors import Conflict, InvalidInput, SlamHiveError, Unavailable
from slamhive.executors.images import CompletedImage, ImageTools
from slamhive.files import remedy_of, temporary_folder
from slamhive.foreign.draft import DraftRequest, described, draft
from slamhive.foreign.facts import find_facts
from slamhive.foreign.folder import SCRIPTS, ForeignFolder, copy_scripts, read_folder
from slamhive.services.algorithms.image_archive import ImageArchive
from slamhive.services.algorithms.planning import ImportRequest, PlannedPackage, Way, plan
from slamhive.services.algorithms.sources import opened
from slamhive.services.datasets import Catalogue, check_writable
from slamhive.services.executors import Executors
from slamhive.settings import Settings

logger = logging.getLogger(__name__)

Progress = Callable[[str], None]
_KEPT_DOCKERFILE = "Dockerfile.imported"
"""Another name than ``Dockerfile``: the image is taken as it is, and not built by ours."""


@dataclass(frozen=True, slots=True)
class ImportedPackage:
    """What an import made: the algorithms, and what to say about them, one line each."""

    algorithms: tuple[Algorithm, ...]
    notes: tuple[str, ...]


class AlgorithmImports:
    """Imports packages.

    Args:
        settings: Where the packages go.
        catalogue: Knows the names that are taken.
        executors: Have the images.
    """

    def __init__(self, settings: Settings, catalogue: Catalogue, executors: Executors) -> None:
        self._settings = settings
        self._catalogue = catalogue
        self._executors = executors

    @contextmanager
    def planned(self, source: str, request: ImportRequest) -> Iterator[PlannedPackage]:
        """Say what an import will do, and keep its source for the block. A repository is fetched, nothing is executed.

        Raises NotFound, InvalidInput, Conflict for a name that is taken, Unavailable.
        """
        with opened(source) as found:
            result = plan(found, request, self._tools(request.executor), self._own_images())
            self._check_free(check_name("package", result.name), replace=request.replace)
            yield result

    def perform(self, planned: PlannedPackage, progress: Progress) -> ImportedPackage:
        """Get the image, complete it, and make the package. A failure leaves no package behind."""
        check_writable(self._settings)
        tools = self._tools(planned.request.executor)
        digest, checksum = _get_image(planned, tools, progress)
        root = self._settings.algorithms_folder
        try:
            root.mkdir(parents=True, exist_ok=True)
            with temporary_folder(".import-", root) as aside:
                folder, scripts = _scripts_of(planned, digest, tools, aside)
                modules = find_facts(scripts).modules
                image = tools.complete(digest, modules, progress, builds=planned.request.builds)
                notes = _write_package(planned, scripts, image, checksum, folder)
                load_algorithms(folder)
                tools.give_name(image.digest, f"slam-hive-algorithm:{planned.name}")
                _put(folder, root / planned.name)
        except OSError as error:
            raise Unavailable(f"{root} cannot be written: {error.strerror or error}", remedy_of(error)) from None
        return ImportedPackage(load_algorithms(root / planned.name), notes)

    def remove(self, name: str, executor: str | None = None) -> str | None:
        """Remove an imported package and the name of its image; in words what could not be removed.

        Runs keep their results. Raises NotFound, and InvalidInput for a package that was not imported.
        """
        check_writable(self._settings)
        folder = self._settings.algorithms_folder / check_name("package", name)
        if not folder.is_dir():
            package = self._catalogue.package(name)
            raise InvalidInput(f"{name} was not imported", f"remove its folder {package.folder}")
        shutil.rmtree(folder)
        try:
            self._tools(executor).remove(f"slam-hive-algorithm:{name}")
        except SlamHiveError as error:
            return f"its image stays: {error.message}"
        return None

    def _tools(self, executor: str | None = None) -> ImageTools:
        return self._executors.get(self._executors.choose(executor)).image_tools()

    def _own_images(self) -> set[str]:
        """The names of the images of packages that were not imported."""
        packages = (algorithm.package for algorithm in self._catalogue.algorithms())
        return {package.image for package in packages if package.folder.parent != self._settings.algorithms_folder}

    def _check_free(self, name: str, *, replace: bool) -> None:
        """Raise Conflict if the name means something else here."""
        if (self._settings.algorithms_folder / name).exists():
            if replace:
                return
            raise Conflict(f"a package {name!r} was imported already", "--replace takes its place, or choose --name")
        taken = {algorithm.package.name for algorithm in self._catalogue.algorithms()}
        taken |= {algorithm.name for algorithm in self._catalogue.algorithms()}
        if name in taken:
            raise Conflict(f"{name!r} is the name of an algorithm here already", "choose another --name")


def _get_image(planned: PlannedPackage, tools: ImageTools, progress: Progress) -> tuple[str, str | None]:
    """The digest of the image, and the checksum of its archive."""
    if planned.way is Way.BUILD:
        if not planned.request.builds:
            raise InvalidInput(f"{planned.name} has no image, and none is built of its Dockerfile", "save its image")
        return tools.build(Path(planned.image).parent, planned.name, progress), None
    if planned.way is Way.TAKE:
        return tools.find(planned.image) or tools.pull(planned.image, progress), None
    archive = ImageArchive(Path(planned.image))
    archive.check()
    return tools.load(archive.chunks(progress)), archive.checksum


def _scripts_of(planned: PlannedPackage, digest: str, tools: ImageTools, aside: Path) -> tuple[Path, ForeignFolder]:
    """The folder of the new package with its scripts, and what was read of them."""
    folder = aside / "package"
    if planned.folder is not None:
        copy_scripts(planned.folder.path, folder / SCRIPTS)
        if planned.folder.dockerfile is not None:
            (folder / _KEPT_DOCKERFILE).write_text(planned.folder.dockerfile, encoding="utf-8")
        return folder, planned.folder
    inside = aside / "image"
    if not tools.copy_scripts(digest, inside / SCRIPTS):
        raise InvalidInput(
            f"image {planned.image} holds no /slamhive/mapping.py",
            "give the folder that holds slamhive/mapping.py, and the image with --image",
        )
    copy_scripts(inside, folder / SCRIPTS)
    return folder, read_folder(inside)


def _write_package(
    planned: PlannedPackage, scripts: ForeignFolder, image: CompletedImage, checksum: str | None, folder: Path
) -> tuple[str, ...]:
    """Write ``algorithm.yaml`` with what is known now; what to say about it."""
    now = utc_now().isoformat(timespec="seconds")
    origin = replace(planned.origin, checksum=checksum, image=image.digest, added=image.added, imported_at=now)
    request = DraftRequest(planned.name, origin, planned.request.setup, image.user)
    result = draft(scripts, find_facts(scripts), request)
    (folder / ALGORITHM_FILE).write_text(result.text, encoding="utf-8")
    notes = list(described(result))
    if image.added:
        notes.append(f"put on top of the image, since the container contract needs it: {', '.join(image.added)}")
    if image.missing:
        notes.append(f"the scripts import {', '.join(image.missing)}, which the image lacks")
    return tuple(notes)


def _put(folder: Path, target: Path) -> None:
    """Move the complete package to its place."""
    if target.exists():
        shutil.rmtree(target)
    folder.rename(target)
