"""Archives: runs and all that they refer to in one file, exported, checked and imported."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.archive.checking import check_archive
    from slamhive.services.archive.exporting import ExportRequest, Part, export_archive
    from slamhive.services.archive.importing import ArchiveImport
    from slamhive.services.archive.lines import dataset_from_line, search_from_line
    from slamhive.services.archive.reading import open_archive

__all__ = [
    "ArchiveImport",
    "ExportRequest",
    "Part",
    "check_archive",
    "dataset_from_line",
    "export_archive",
    "open_archive",
    "search_from_line",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
