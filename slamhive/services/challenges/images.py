"""Brings the image of a submission into the installation in which it runs. Nothing is built, and no name is taken.

The team may read in full what goes wrong here: the image has not seen a recording yet.
"""

from __future__ import annotations

import os
import shutil
import tarfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Protocol

from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.base.files import held_folder, remedy_of
from slamhive.base.settings import Settings
from slamhive.documents.challenge import ImageRules, StoredImage
from slamhive.documents.limits import Limits
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Playback
from slamhive.domain.packages import version_label
from slamhive.executors.base import EngineUnavailable, Executor, ImageMissing, PackageNeed
from slamhive.packages.algorithm_file import load_algorithms, version_folder
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.staging import seal
from slamhive.services.algorithms import AlgorithmImports, ImageArchive, PackageImportRequest
from slamhive.services.challenges.definition import SubmissionFolder
from slamhive.services.executors import Executors
from slamhive.services.runs import RunService, check_executor
from slamhive.services.versions import Versions, is_export, opened_version
from slamhive.services.weights import WEIGHTS, WeightsStore
from slamhive.store import Store, VersionRecord

# Archives that teams send. Nothing in them is executed.

MB = 1_000_000
_ENTRY_BYTES = 4096
"""What an entry of an archive takes on a disk, however small it is."""
_ZSTD = b"\x28\xb5\x2f\xfd"
_REMEDY = "export it again with slamhive algorithm export, or docker save"


def check_image(path: Path, algorithm: str | None, largest_mb: int) -> StoredImage:
    """Check the archive at ``path``: a version that was exported, or an image that ``docker save`` wrote.

    Args:
        path: The archive.
        algorithm: The algorithm of its package that a team has chosen.
        largest_mb: Most that it may have, packed and unpacked (MB).

    Raises InvalidInput if it is damaged or too large, or holds no such algorithm.
    """
    left = largest_mb * MB
    with _reading(path):
        if path.stat().st_size > left:
            raise _too_large(path, largest_mb)
        # Small files can unpack to much.
        with tarfile.open(path, mode="r|*") as archive:
            for member in archive:
                left -= _ENTRY_BYTES
                content = archive.extractfile(member) if member.isreg() else None
                if content is not None:
                    left -= max(member.size, _unpacked(path, content, max(left, 0)))
                if left < 0:
                    raise _too_large(path, largest_mb)
    if not is_export(path):
        ImageArchive(path).check()
        return StoredImage(package=None, algorithm=algorithm)
    with opened_version(path) as packed:
        if not packed.has_image:
            raise InvalidInput(f"{path.name} holds a package without an image", _REMEDY)
        chosen = choose_algorithm(load_algorithms(packed.package.folder), algorithm)
        return StoredImage(package=packed.package.name, algorithm=chosen.name)


def choose_algorithm(algorithms: tuple[Algorithm, ...], asked: str | None) -> Algorithm:
    """The algorithm that is called ``asked``, or the only one; raises InvalidInput."""
    names = ", ".join(entry.name for entry in algorithms)
    if asked is None and len(algorithms) > 1:
        raise InvalidInput(f"the package has several algorithms: {names}", "choose one of them")
    for entry in algorithms:
        if asked in (None, entry.name):
            return entry
    raise InvalidInput(f"the package has no algorithm {str(asked)[:80]!r}", f"it has {names}")


def _unpacked(path: Path, content: IO[bytes], most: int) -> int:
    """Measure the unpacked size of a layer (bytes), counted until it is more than ``most``; 0 for anything else."""
    if content.peek(4)[:4] == _ZSTD:  # type: ignore[attr-defined]
        raise InvalidInput(f"{path.name} has layers that were packed with zstd", "save it with docker save")
    found = 0
    try:
        with tarfile.open(fileobj=content, mode="r|*") as layer:
            for member in layer:
                found += _ENTRY_BYTES + max(member.size, 0)
                if found > most:
                    break
    except (tarfile.ReadError, EOFError, zlib.error):
        return found
    return found


def _too_large(path: Path, largest_mb: int) -> InvalidInput:
    return InvalidInput(f"{path.name} has more than {largest_mb:,} MB when it is unpacked", "send a smaller image")


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except (tarfile.TarError, OSError, EOFError, zlib.error, OverflowError, ValueError) as error:
        raise InvalidInput(f"{path.name} cannot be read as an archive: {error}", _REMEDY) from None


# Recordings are copied once, and linked into the installation of each image.


def keep_recording(source: Path, name: str, target: Path) -> None:
    """Copy the recording of the dataset in ``source`` to ``target`` as the dataset ``name``, without ground truth.

    Raises InvalidInput if it is no dataset with a recording; OSError if the disk refuses.
    """
    try:
        dataset = load_dataset(source)
        bag = dataset.bag_path
    except SlamHiveError as error:
        raise InvalidInput(
            f"the recording of sequence {name} cannot be used: {error}",
            "name the folder of a dataset, such as data/datasets/NAME",
        ) from None
    if not bag.exists():
        raise InvalidInput(f"the recording of sequence {name} lacks {bag}", "import it again")
    target.mkdir(parents=True)
    if bag.is_dir():
        shutil.copytree(bag, target / dataset.bag)
    else:
        shutil.copyfile(bag, target / dataset.bag)
    seal(target, replace(dataset, name=name, folder=target, groundtruth=None, relations=None, reference_map=None))


def link_folder(source: Path, target: Path) -> None:
    """Let ``target`` have the files of ``source``, without a copy. Does nothing if it is there. Raises Unavailable."""
    if target.exists():
        return
    aside = target.with_name(f".{target.name}")
    shutil.rmtree(aside, ignore_errors=True)
    try:
        with held_folder(aside):
            shutil.copytree(source, aside, copy_function=os.link, dirs_exist_ok=True)
            aside.rename(target)
    except OSError as error:
        shutil.rmtree(aside, ignore_errors=True)
        raise Unavailable(f"{target} cannot be made: {error.strerror or error}", remedy_of(error)) from None


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
        """Executors of its runs."""

    @property
    def versions(self) -> Versions:
        """Has one: the image."""

    @property
    def algorithms(self) -> AlgorithmImports:
        """Drafts a package for an image that has none."""

    @property
    def runs(self) -> RunService:
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
            # What docker save wrote gets a package. Its name is that of the submission, so it hides no other.
            request = PackageImportRequest(name=name, executor=executor.name, replace=True, builds=False)
            with installation.algorithms.planned(identity, request) as planned:
                package = installation.algorithms.perform(planned, _say_nothing).algorithms[0].package
            record = installation.versions.register(executor, package, identity)
            executor.image_tools().remove(package.image)  # the version has a name of its own
            return record
        return _exported(installation, executor, found, identity)
    except (InvalidInput, ImageMissing):
        executor.forget(name, identity, 1)
        raise


def _exported(installation: Installation, executor: Executor, found: SubmissionFolder, identity: str) -> VersionRecord:
    with opened_version(found.image) as packed:
        if identity != packed.identity:
            raise InvalidInput(f"the archive holds image {identity[:19]}, not {packed.identity[:19]}")
        return installation.versions.register(executor, packed.package, identity)


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
        check_executor(
            executor_of(installation), found.package, Limits(cpu_cores=rules.cpu_cores, memory_mb=rules.memory_mb)
        )
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
