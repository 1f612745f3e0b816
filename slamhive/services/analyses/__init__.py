"""Stored analyses: a queue of analysis files and their reports."""

from __future__ import annotations

from slamhive.services.analyses.folder import FIGURES, PAGE, REPORT, SOURCE, AnalysisFolder
from slamhive.services.analyses.jobs import AnalysisJobs
from slamhive.services.analyses.stored import MAX_TEXT_BYTES, StoredAnalyses, may_analyse

__all__ = [
    "FIGURES",
    "MAX_TEXT_BYTES",
    "PAGE",
    "REPORT",
    "SOURCE",
    "AnalysisFolder",
    "AnalysisJobs",
    "StoredAnalyses",
    "may_analyse",
]
