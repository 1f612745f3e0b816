"""Archives: runs and all that they refer to in one file, exported, checked and imported."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.archive.checking import archived_dataset, check_archive, recorded_runs
    from slamhive.services.archive.exporting import ExportRequest, export_archive
    from slamhive.services.archive.extras import Extra
    from slamhive.services.archive.importing import ArchiveImport, ArchiveReport
    from slamhive.services.archive.layout import version_member
    from slamhive.services.archive.lines import dataset_from_line, search_from_line
    from slamhive.services.archive.reading import ArchiveReader, open_archive
    from slamhive.services.archive.run_files import Part

__all__ = [
    "ArchiveImport",
    "ArchiveReader",
    "ArchiveReport",
    "ExportRequest",
    "Extra",
    "Part",
    "archived_dataset",
    "check_archive",
    "dataset_from_line",
    "export_archive",
    "open_archive",
    "recorded_runs",
    "search_from_line",
    "version_member",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
