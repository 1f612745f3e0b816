"""What an export adds on request, so that its runs can be repeated elsewhere: packages, images and recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from slamhive.bags.staging import recording_files
from slamhive.domain.dataset import Dataset
from slamhive.domain.versions import version_label
from slamhive.services.archive.layout import version_member
from slamhive.services.archive.writing import ArchiveWriter
from slamhive.services.runs import check_dataset_files
from slamhive.services.versions import Versions
from slamhive.store.records import AlgorithmVersion


class Extra(StrEnum):
    """What an export adds."""

    PACKAGES = "packages"
    IMAGES = "images"
    RECORDINGS = "recordings"


@dataclass(frozen=True, slots=True)
class Packing:
    """How versions are packed: by whom, in which empty folder meanwhile, and whether with their images."""

    versions: Versions
    aside: Path
    images: bool


def add_versions(
    archive: ArchiveWriter, used: Iterable[tuple[str, AlgorithmVersion]], packing: Packing
) -> Counter[str]:
    """Add the versions that runs used; how many images and packages were added. Raises as :meth:`Versions.pack`."""
    counts: Counter[str] = Counter()
    for package, version in sorted(used, key=str):
        record = packing.versions.find(version_label(package, version.number or 0))
        path = packing.aside / "version.tar"
        with_image = packing.versions.pack(record, path, image=packing.images)
        archive.add_file(version_member(package, version.identity, version.package_hash), path)
        path.unlink()
        counts["images" if with_image else "packages"] += 1
    return counts


def add_recording(archive: ArchiveWriter, dataset: Dataset) -> None:
    """Add the recording of a dataset; raises InvalidInput if it is missing."""
    check_dataset_files(dataset)
    for file in recording_files(dataset.bag_path):
        archive.add_file(f"datasets/{dataset.name}/{file.relative_to(dataset.folder)}", file)
