"""Algorithm packages that somebody else made: imported from a folder, a repository, an image or an archive; removed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.algorithms.image_archive import ImageArchive
    from slamhive.services.algorithms.planning import ImportRequest, PlannedPackage
    from slamhive.services.algorithms.service import AlgorithmImports, ImportedPackage

__all__ = [
    "AlgorithmImports",
    "ImageArchive",
    "ImportRequest",
    "ImportedPackage",
    "PlannedPackage",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
