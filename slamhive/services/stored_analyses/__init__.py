"""Stored analyses: a queue of analysis files and their reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.stored_analyses.computing import (
        MOST_PREVIEWED_RUNS,
        AnalysisComputer,
        AnalysisJobs,
        AnalysisPreviews,
        Preview,
    )
    from slamhive.services.stored_analyses.stored import (
        FIGURES,
        MAX_TEXT_BYTES,
        MEDIA_TYPES,
        PAGE,
        PREVIEWS,
        REPORT,
        SOURCE,
        AnalysisFiles,
        AnalysisFolder,
        StoredAnalyses,
        may_analyse,
    )


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
