"""The recordings that a replay needs: found by checksum in this installation, or in the bundle."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from slamhive.bags.staging import checksum
from slamhive.domain.dataset import Dataset
from slamhive.errors import InvalidInput, NotFound, Unavailable
from slamhive.files import remedy_of
from slamhive.services.archive import ArchiveReader, archived_dataset
from slamhive.services.datasets import Catalogue

Progress = Callable[[float, str], None]
_SHOWN = 19
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
        return frozenset(name for name, wanted in self._wanted.items() if not self._is_here(name, wanted))

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

    def _is_here(self, name: str, wanted: str | None) -> bool:
        exists = self._catalogue.dataset_folder(name).exists()
        dataset = self._catalogue.dataset(name) if exists else archived_dataset(self._archive, name)
        if dataset is None:
            raise NotFound(f"dataset {name} is neither here nor described in the bundle", "export the bundle again")
        if wanted is not None and dataset.checksum != wanted:
            where = "is another one here" if exists else "is described as another one"
            raise InvalidInput(
                f"dataset {name} {where}: its checksum is {dataset.checksum[:_SHOWN]}, the recorded runs used "
                f"{wanted[:_SHOWN]}",
                "replay into an empty data root: --into FOLDER",
            )
        if exists and dataset.bag_path.exists():
            return True
        if self._donor(dataset) is None and not self._members(dataset):
            raise NotFound(
                f"the recording {dataset.bag} of dataset {name} ({dataset.checksum[:_SHOWN]}) is neither here nor in "
                "the bundle",
                _where_to_get(dataset),
            )
        return False

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


def _where_to_get(dataset: Dataset) -> str:
    source = f" it comes from {dataset.source};" if dataset.source else ""
    return (
        f"slamhive dataset fetch gets public sequences (slamhive dataset search {dataset.name});{source} or ask for a "
        "bundle that was exported --with recordings"
    )
