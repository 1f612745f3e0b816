"""Catalogue of algorithms and datasets, and the variants of datasets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.datasets.catalogue import (
        Catalogue,
        PlannedImport,
        algorithm_here_or_elsewhere,
        check_writable,
        choose_algorithm,
        dataset_document,
        imported_algorithms,
        stored_numbers,
        trajectory_frame,
    )
    from slamhive.services.datasets.variants import (
        IDENTITY,
        REPORT_FILE,
        TRIAL_FILE,
        DatasetChecks,
        TruthTrials,
        UsedVariant,
        VariantService,
        constant_in_words,
        draw_trial,
        stretch_in_words,
        variant_key,
    )
    from slamhive.services.datasets.views import (
        DatasetViews,
        MotionSummary,
        draw_ground_truth,
        ground_truth_motion,
        motion_summary,
        strip_times_s,
    )


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
