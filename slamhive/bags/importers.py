"""Dataset importers, which turn a recording of some format into a dataset folder.

To add one: write a class with ``name``, ``detect`` and ``convert`` and register an instance, here or through the
entry-point group ``slamhive.dataset_importers``. ``docs/dataset-format.md`` says what a dataset folder holds.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from slamhive.bags.detection import Detection
from slamhive.bags.kitti_odometry import KittiOdometryImporter
from slamhive.bags.staging import Progress
from slamhive.domain.dataset import Dataset
from slamhive.errors import InvalidInput
from slamhive.registry import Registry


class Importer(Protocol):
    """Converts one format."""

    name: str

    def detect(self, path: Path) -> Detection:
        """Check quickly whether ``path`` has this format."""
        ...

    def convert(self, source: Path, folder: Path, name: str, progress: Progress) -> Dataset:
        """Make the dataset ``name`` in ``folder`` completely, or raise InvalidInput, Conflict or Unavailable."""
        ...


IMPORTERS: Registry[Importer] = Registry("dataset importer", "slamhive.dataset_importers")
IMPORTERS.register(KittiOdometryImporter.name, KittiOdometryImporter())


AUTO = "auto"
"""Instead of a format: choose the one that fits."""


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
