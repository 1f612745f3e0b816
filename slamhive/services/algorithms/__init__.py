"""Algorithm packages that somebody else made: imported from a folder, a repository, an image or an archive; removed."""

from __future__ import annotations

from slamhive.services.algorithms.planning import ImportRequest, PlannedPackage
from slamhive.services.algorithms.service import AlgorithmImports, ImportedPackage

__all__ = [
    "AlgorithmImports",
    "ImportRequest",
    "ImportedPackage",
    "PlannedPackage",
]
