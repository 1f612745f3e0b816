"""What can run on what: the catalogue of algorithms and datasets, and the variants of datasets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.datasets.catalogue import Catalogue, PlannedImport, check_writable, dataset_document
    from slamhive.services.datasets.checking import REPORT_FILE, DatasetChecks
    from slamhive.services.datasets.external import algorithm_here_or_elsewhere, choose_algorithm, imported_algorithms
    from slamhive.services.datasets.numbers import stored_numbers
    from slamhive.services.datasets.variants import IDENTITY, UsedVariant, Variants, variant_key
    from slamhive.services.datasets.views import (
        DatasetViews,
        MotionSummary,
        draw_ground_truth,
        ground_truth_motion,
        motion_summary,
        strip_times_s,
    )

__all__ = [
    "IDENTITY",
    "REPORT_FILE",
    "Catalogue",
    "DatasetChecks",
    "DatasetViews",
    "MotionSummary",
    "PlannedImport",
    "UsedVariant",
    "Variants",
    "algorithm_here_or_elsewhere",
    "check_writable",
    "choose_algorithm",
    "dataset_document",
    "draw_ground_truth",
    "ground_truth_motion",
    "imported_algorithms",
    "motion_summary",
    "stored_numbers",
    "strip_times_s",
    "variant_key",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
