"""Archives: runs and all that they refer to in one file, exported, checked and imported."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.archive.exporting import ExportRequest, Extra, export_archive
    from slamhive.services.archive.importing import ArchiveImport, ArchiveReport
    from slamhive.services.archive.layout import ArchivePart, version_member
    from slamhive.services.archive.reading import (
        ArchiveReader,
        archived_dataset,
        check_archive,
        open_archive,
        recorded_runs,
    )
    from slamhive.services.archive.writing import dataset_from_line, search_from_line


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
