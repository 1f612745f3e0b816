"""Brings the image of a submission into the installation in which it runs. Nothing is built, and no name is taken.

The team may read in full what goes wrong here: the image has not seen a recording yet.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Protocol

from slamhive.catalogue.algorithm_file import load_algorithms
from slamhive.catalogue.version_folders import version_folder
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Playback
from slamhive.domain.versions import version_label
from slamhive.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.executors.base import EngineUnavailable, Executor, ImageMissing, PackageNeed
from slamhive.schema.challenge import ImageRules, StoredImage
from slamhive.services.algorithms import AlgorithmImports, ImageArchive, ImportRequest
from slamhive.services.challenges.folder import SubmissionFolder
from slamhive.services.challenges.packed_images import choose_algorithm
from slamhive.services.challenges.recordings import link_folder
from slamhive.services.executors import Executors
from slamhive.services.runs import RunLimits, Runs, check_executor
from slamhive.services.versions import Versions, opened_version
from slamhive.services.weights import WEIGHTS, WeightsStore
from slamhive.settings import Settings
from slamhive.store import Store, VersionRecord


class SomeRuns(Protocol):
    """A worker for some runs."""

    def run(self, *, until_idle: bool = False, cores: tuple[int, ...] | None = None) -> None:
        """Work on them, on these cores, until they have ended, or until it is stopped."""

    def stop(self) -> None:
        """Stop; runs go on."""


class Installation(Protocol):
    """The installation in which one image runs: a data root below ``secret/``, with a database of its own."""

    @property
    def settings(self) -> Settings:
        """Of the organiser, with this data root."""

    @property
    def store(self) -> Store:
        """Its database."""

    @property
    def executors(self) -> Executors:
        """What runs are executed by."""

    @property
    def versions(self) -> Versions:
        """Has one: the image."""

    @property
    def algorithms(self) -> AlgorithmImports:
        """Drafts a package for an image that has none."""

    @property
    def runs(self) -> Runs:
        """The runs of the image."""

    def worker(self, only: list[int]) -> SomeRuns:
        """A worker for these runs."""

    def close(self) -> None:
        """Close the database and the connections to engines."""


class ImageRefused(SlamHiveError):
    """An image that cannot run, for a reason that its team may read in full."""


def executor_of(installation: Installation) -> Executor:
    """The executor that images run by; raises Unavailable if it does not shut them in, or has no images."""
    found = installation.executors.get(installation.executors.choose())
    if not found.capabilities.isolates or found.capabilities.needs is not PackageNeed.IMAGE:
        raise Unavailable(
            f"images of challenges cannot run by the executor {found.name}, which does not isolate images",
            "set EXECUTOR to docker",
        )
    return found


def load_image(installation: Installation, found: SubmissionFolder, kept_versions: Path) -> VersionRecord:
    """The version that runs use; loads the image unless that was done before.

    Args:
        installation: In which it runs.
        found: The submission.
        kept_versions: The folders of the versions of the organiser's installation.

    Raises:
        ImageRefused: The image cannot be used.
        Unavailable: Engine, database or disk refuse; it can be tried again.
    """
    known = installation.store.read(lambda t: t.versions.all())
    if known:
        return known[0]
    executor, image = executor_of(installation), found.sent.image
    assert image is not None  # only submissions with an image get here
    try:
        if image.version is not None:
            return _of_server(installation, executor, image, kept_versions)
        return _of_archive(installation, executor, found, image)
    except EngineUnavailable:
        raise
    except (InvalidInput, ImageMissing) as error:
        raise ImageRefused(error.message.replace(str(found.image), "the archive"), error.remedy) from None


def _of_server(
    installation: Installation, executor: Executor, image: StoredImage, kept_versions: Path
) -> VersionRecord:
    assert image.package is not None  # a version has all three
    assert image.version is not None
    assert image.identity is not None
    folder = version_folder(kept_versions, image.package, image.version)
    if not folder.is_dir():
        raise InvalidInput(f"{version_label(image.package, image.version)} was removed", "submit another version")
    package = load_algorithms(folder)[0].package
    weights = kept_versions.parent / WEIGHTS / image.package
    if package.weights and weights.is_dir():
        link_folder(weights, installation.settings.data / WEIGHTS / image.package)
    if not executor.has(package, image.identity):
        raise ImageMissing(f"the image of {version_label(image.package, image.version)} is gone", "submit it again")
    return installation.versions.register(executor, package, image.identity)


def _of_archive(
    installation: Installation, executor: Executor, found: SubmissionFolder, image: StoredImage
) -> VersionRecord:
    identity = executor.load_image(ImageArchive(found.image).chunks(_say_nothing))
    name = f"challenge-{found.root.name}"
    try:
        if image.package is None:
            return _drafted(installation, executor, identity, name)
        return _exported(installation, executor, found, identity)
    except (InvalidInput, ImageMissing):
        executor.forget(name, identity, 1)
        raise


def _exported(installation: Installation, executor: Executor, found: SubmissionFolder, identity: str) -> VersionRecord:
    with opened_version(found.image) as packed:
        if identity != packed.identity:
            raise InvalidInput(f"the archive holds image {identity[:19]}, not {packed.identity[:19]}")
        return installation.versions.register(executor, packed.package, identity)


def _drafted(installation: Installation, executor: Executor, identity: str, name: str) -> VersionRecord:
    """A package for an image that ``docker save`` wrote. Its name is that of the submission, so it hides no other."""
    request = ImportRequest(name=name, executor=executor.name, replace=True, builds=False)
    with installation.algorithms.planned(identity, request) as planned:
        package = installation.algorithms.perform(planned, _say_nothing).algorithms[0].package
    record = installation.versions.register(executor, package, identity)
    executor.image_tools().remove(package.image)  # the version has a name of its own
    return record


def algorithm_of(
    installation: Installation, version: VersionRecord, image: StoredImage, rules: ImageRules
) -> Algorithm:
    """The algorithm that runs, in this version: so its image is never built or pulled.

    Raises ImageRefused if there is none, or if it cannot run under the rules on any recording.
    """
    folder = version_folder(installation.settings.versions_folder, version.package, version.number)
    try:
        found = choose_algorithm(load_algorithms(folder), image.algorithm)
        found.package.check_playback(Playback(rules.playback, rules.rate))
        check_executor(executor_of(installation), found.package, RunLimits(rules.cpu_cores, rules.memory_mb))
        WeightsStore(installation.settings).check_present(found.package)
    except InvalidInput as error:
        raise ImageRefused(error.message, error.remedy) from None
    return replace(found, version=version.number)


def forget_image(installation: Installation) -> None:
    """Remove what the engine has of the image, unless others use it."""
    executor = executor_of(installation)
    for record in installation.store.read(lambda t: t.versions.all()):
        executor.forget(record.package, record.identity, record.number)


def _say_nothing(_line: str) -> None:
    """Nobody waits for these lines."""
