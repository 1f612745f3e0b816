"""Dataset importers: each turns recordings of one format into dataset folders.

Importers of other packages come in through the entry-point group ``slamhive.dataset_importers``;
``docs/extend/index.md`` shows one, and ``docs/dataset-format.md`` says what a dataset folder holds.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

from slamhive.bags.detection import Detection
from slamhive.bags.kitti_odometry import KittiOdometryImporter
from slamhive.bags.staging import Progress
from slamhive.domain.dataset import Dataset
from slamhive.errors import InvalidInput
from slamhive.registry import Registry, instances_of


@runtime_checkable
class Importer(Protocol):
    """Turns recordings of one format into dataset folders."""

    def detect(self, path: Path) -> Detection:
        """Say what at ``path`` speaks for the format and what is missing, without reading much."""
        ...

    def convert(self, source: Path, folder: Path, name: str, progress: Progress) -> Dataset:
        """Make the dataset ``name`` in ``folder`` completely, or raise InvalidInput, Conflict or Unavailable."""
        ...


IMPORTERS: Registry[Importer] = Registry("dataset importer", "slamhive.dataset_importers", instances_of(Importer))
IMPORTERS.register("kitti-odometry", KittiOdometryImporter())

AUTO = "auto"
"""Stands for the format that fits."""


def detect_format(path: Path) -> str:
    """The name of the importer that can convert ``path``.

    Raises InvalidInput that names, for the format that fits best, what is missing.
    """
    detections = {name: importer.detect(path) for name, importer in IMPORTERS}
    for name, detection in detections.items():
        if detection.complete:
            return name
    name, nearest = max(detections.items(), key=lambda entry: len(entry[1].found))
    if not nearest.found:
        raise InvalidInput(
            f"{path} is in no format that can be imported", f"known formats: {', '.join(IMPORTERS.names())}"
        )
    raise InvalidInput(
        f"{path} looks like {name} (found {', '.join(nearest.found)}), but lacks {', '.join(nearest.missing)}",
        "add what is missing",
    )
