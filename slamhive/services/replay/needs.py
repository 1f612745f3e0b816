"""Request for a replay, and what it needs and finds in the bundle."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from slamhive.base.errors import Conflict, InvalidInput, NotFound, Unavailable
from slamhive.base.files import make_shared_folder, remedy_of, temporary_folder
from slamhive.documents.gate import BaselineConfiguration
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.domain.dataset import Dataset
from slamhive.domain.gate import Margin
from slamhive.domain.run import RunState
from slamhive.executors.base import Executor, ImageMissing, PackageNeed, ProgressCallback
from slamhive.recordings.staging import checksum
from slamhive.services.algorithms import ImageArchive
from slamhive.services.archive import ArchiveReader, archived_dataset, recorded_runs, version_member
from slamhive.services.datasets import Catalogue
from slamhive.services.versions import PackedVersion, Versions, opened_version
from slamhive.store import RunRecord, VersionRecord
from slamhive.store.records import AlgorithmVersion


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """Options of a replay.

    Attributes:
        path: The bundle, a file that ``slamhive archive export`` wrote.
        repeats: How often each configuration runs.
        executor: Where; None for the executor of the recorded runs.
        load_image: Whether packages and images may be taken from the bundle. They are code that runs here.
        rebuild: Whether a package may be built again, which makes another image or environment.
        margins: Texts such as ``ate.rmse=5%``, on top of the defaults.
    """

    path: Path
    repeats: int = 5
    executor: str | None = None
    load_image: bool = False
    rebuild: bool = False
    margins: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Needs:
    """The runs of a bundle that can run again, by uid, and {dataset: checksum}; how many others there are, by reason.

    The checksum is None if it was not recorded.
    """

    uids: tuple[str, ...]
    datasets: Mapping[str, str | None]
    left_out: Counter[str]


def needs_of(archive: ArchiveReader) -> Needs:
    """Collect the needs of the bundle; raises InvalidInput if none of its runs can run again."""
    uids, datasets, left_out = [], dict[str, str | None](), Counter[str]()
    for _, file in recorded_runs(archive):
        reason = None
        if file.imported is not None:
            reason = "made by another tool"
        elif file.state not in (RunState.SUCCEEDED, RunState.FAILED) or file.algorithm.identity is None:
            reason = "never ran to an end"
        if reason is not None:
            left_out[reason] += 1
            continue
        name, checksum = file.request.dataset, file.dataset.checksum
        if datasets.setdefault(name, checksum) != checksum:
            raise InvalidInput(f"the runs of the bundle used several contents of dataset {name}", "export some of them")
        uids.append(file.uid)
    if not uids:
        found = ", ".join(f"{count} {reason}" for reason, count in left_out.items())
        raise InvalidInput(
            f"no run of the bundle can run again: {found}", "slamhive archive verify shows what it holds"
        )
    return Needs(tuple(uids), datasets, left_out)


@dataclass(frozen=True, slots=True)
class Recorded:
    """One configuration of a bundle: its recorded runs with their values, and the version that will run again.

    ``executor`` is the name of the one that runs it.
    """

    held: BaselineConfiguration
    runs: tuple[RunRecord, ...]
    version: VersionRecord
    executor: str

    @property
    def recorded_identity(self) -> str:
        """The image or environment of the recorded runs."""
        version = self.runs[0].version
        assert version is not None
        return version.identity


@dataclass(frozen=True, slots=True)
class Prepared:
    """A replay that can begin."""

    request: ReplayRequest
    margins: Mapping[str, Margin]
    configurations: tuple[Recorded, ...]
    notes: tuple[str, ...]


# Versions: exactly those of the record, unless it is allowed to build them again.

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
        if package is None:
            offered = self._archive.has(member)
            raise NotFound(
                f"package {name}, as the recorded runs used it, is not here",
                _LOAD if offered else "ask for a bundle that was exported --with packages or --with images",
            )
        return self._built(package, wanted, executor, offered=self._archive.has(member))

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


# Recordings, found by checksum in this installation or in the bundle.

Progress = Callable[[float, str], None]
"""So much of a checksum is shown: ``sha256:`` and twelve digits."""


class Recordings:
    """Finds the recordings of one bundle.

    Args:
        catalogue: The datasets that are here.
        archive: The bundle.
        wanted: {dataset: checksum of its recording}, None for one that was not recorded.
    """

    def __init__(self, catalogue: Catalogue, archive: ArchiveReader, wanted: Mapping[str, str | None]) -> None:
        self._catalogue = catalogue
        self._archive = archive
        self._wanted = wanted

    def check(self) -> frozenset[str]:
        """The datasets whose recordings are not in their place yet, and can be had. Nothing changes.

        Raises InvalidInput if a dataset of one of the names is another one here, NotFound if a recording is missing.
        """
        missing: set[str] = set()
        for name, wanted in self._wanted.items():
            exists = self._catalogue.dataset_folder(name).exists()
            dataset = self._catalogue.dataset(name) if exists else archived_dataset(self._archive, name)
            if dataset is None:
                problem = f"dataset {name} is neither here nor described in the bundle"
                raise NotFound(problem, "export the bundle again")
            if wanted is not None and dataset.checksum != wanted:
                where = "is another one here" if exists else "is described as another one"
                raise InvalidInput(
                    f"dataset {name} {where}: its checksum is {dataset.checksum[:_SHOWN]}, the recorded runs used "
                    f"{wanted[:_SHOWN]}",
                    "replay into an empty data root: --into FOLDER",
                )
            if exists and dataset.bag_path.exists():
                continue
            if self._donor(dataset) is None and not self._members(dataset):
                source = f" it comes from {dataset.source};" if dataset.source else ""
                raise NotFound(
                    f"the recording {dataset.bag} of dataset {name} ({dataset.checksum[:_SHOWN]}) is neither here nor "
                    "in the bundle",
                    f"slamhive dataset fetch gets public sequences (slamhive dataset search {dataset.name});{source} "
                    "or ask for a bundle that was exported --with recordings",
                )
            missing.add(name)
        return frozenset(missing)

    def place(self, lacking: frozenset[str], progress: Progress) -> None:
        """Put the recordings of ``lacking`` into their places, and compare all with their checksums.

        The datasets are here, and the archive was verified. Raises InvalidInput for a recording that is another one.
        """
        for name in self._wanted:
            dataset = self._catalogue.dataset(name)
            if not dataset.bag_path.exists():
                self._put(dataset)
            found = checksum(dataset.bag_path, lambda share, text: progress(share, f"{text} of {name}"))  # noqa: B023
            if found != dataset.checksum:
                if name in lacking:
                    _remove(dataset.bag_path)
                raise InvalidInput(
                    f"the recording of {name} has checksum {found[:_SHOWN]}, its dataset.yaml says "
                    f"{dataset.checksum[:_SHOWN]}",
                    f"get {dataset.bag} again",
                )

    def _donor(self, dataset: Dataset) -> Path | None:
        """The recording of another dataset that is here with the same checksum."""
        for other in self._catalogue.datasets():
            same = other.checksum == dataset.checksum and other.bag and other.name != dataset.name
            if same and other.bag_path.exists():
                return other.bag_path
        return None

    def _members(self, dataset: Dataset) -> list[str]:
        own = f"datasets/{dataset.name}/{dataset.bag}"
        return [own] if self._archive.has(own) else self._archive.below(f"{own}/")

    def _put(self, dataset: Dataset) -> None:
        """Link the recording of another dataset, or unpack that of the bundle."""
        donor = self._donor(dataset)
        with _put_in_place(dataset.bag_path) as aside:
            if donor is not None and donor.is_dir():
                shutil.copytree(donor, aside, copy_function=_link)
            elif donor is not None:
                _link(donor, aside)
            for member in self._members(dataset) if donor is None else ():
                inside = member.removeprefix(f"datasets/{dataset.name}/{dataset.bag}").removeprefix("/")
                self._archive.unpack(member, aside / inside if inside else aside)


@contextmanager
def _put_in_place(target: Path) -> Iterator[Path]:
    """A path beside ``target``, which becomes ``target`` when the block succeeds. Raises Unavailable."""
    aside = target.with_name(f".{target.name}.partial")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove(aside)
        yield aside
        aside.rename(target)
    except OSError as error:
        raise Unavailable(f"{target} cannot be written: {error.strerror or error}", remedy_of(error)) from None
    finally:
        _remove(aside)


def _link(source: Path | str, target: Path | str) -> None:
    """A second name of the same file, or a copy where the file system has none."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
