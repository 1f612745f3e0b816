"""Stored analyses: a queue of analysis files and their reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.analyses.computer import AnalysisComputer
    from slamhive.services.analyses.files import MEDIA_TYPES, AnalysisFiles
    from slamhive.services.analyses.folder import FIGURES, PAGE, PREVIEWS, REPORT, SOURCE, AnalysisFolder
    from slamhive.services.analyses.jobs import AnalysisJobs
    from slamhive.services.analyses.previews import MOST_PREVIEWED_RUNS, AnalysisPreviews, Preview
    from slamhive.services.analyses.stored import MAX_TEXT_BYTES, StoredAnalyses, may_analyse

__all__ = [
    "FIGURES",
    "MAX_TEXT_BYTES",
    "MEDIA_TYPES",
    "MOST_PREVIEWED_RUNS",
    "PAGE",
    "PREVIEWS",
    "REPORT",
    "SOURCE",
    "AnalysisComputer",
    "AnalysisFiles",
    "AnalysisFolder",
    "AnalysisJobs",
    "AnalysisPreviews",
    "Preview",
    "StoredAnalyses",
    "may_analyse",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
