"""Experiments: many runs from one file; preview, start, status, report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.experiments.answer import (
        pair_sentence,
        question,
    )
    from slamhive.services.experiments.context import GUESSED_START_S, ExperimentContext, Progress, guessed_duration_s
    from slamhive.services.experiments.folder import RECORD, SOURCE, ExperimentFolder, StoredExperiment
    from slamhive.services.experiments.progress import METRICS, is_failing, status_of
    from slamhive.services.experiments.ranking import (
        NO_FIGURES,
        RANKED_BY,
        RankedCell,
        RankEntry,
        Ranking,
        csv_text,
        failures_text,
        varying,
    )
    from slamhive.services.experiments.service import ExperimentService
    from slamhive.services.experiments.starting import Restored
    from slamhive.services.experiments.views import (
        Cell,
        CellFigures,
        ExperimentGrid,
        ExperimentSource,
        GridCell,
        MetricGrid,
        MetricSpread,
    )


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
