"""Experiments: many runs from one file; preview, start, status, report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.experiments.context import ExperimentContext, Progress
    from slamhive.services.experiments.expected import GUESSED_START_S, guessed_duration_s
    from slamhive.services.experiments.folder import RECORD, SOURCE, ExperimentFolder, StoredExperiment
    from slamhive.services.experiments.ranking import RANKED_BY, RankedCell, Ranking
    from slamhive.services.experiments.reporting import NO_FIGURES, csv_text, failures_text, varying
    from slamhive.services.experiments.restoring import Restored
    from slamhive.services.experiments.service import Experiments
    from slamhive.services.experiments.status import METRICS, is_failing, status_of
    from slamhive.services.experiments.views import (
        ENDED,
        Cell,
        CellFigures,
        ExperimentPreview,
        ExperimentSource,
        ExperimentStatus,
        Failure,
        Grid,
        GridCell,
        NodesPlan,
        Phase,
        Spread,
        Standing,
        failure_words,
    )

__all__ = [
    "ENDED",
    "GUESSED_START_S",
    "METRICS",
    "NO_FIGURES",
    "RANKED_BY",
    "RECORD",
    "SOURCE",
    "Cell",
    "CellFigures",
    "ExperimentContext",
    "ExperimentFolder",
    "ExperimentPreview",
    "ExperimentSource",
    "ExperimentStatus",
    "Experiments",
    "Failure",
    "Grid",
    "GridCell",
    "NodesPlan",
    "Phase",
    "Progress",
    "RankedCell",
    "Ranking",
    "Restored",
    "Spread",
    "Standing",
    "StoredExperiment",
    "csv_text",
    "failure_words",
    "failures_text",
    "guessed_duration_s",
    "is_failing",
    "status_of",
    "varying",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
