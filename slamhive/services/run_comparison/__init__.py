"""Comparing a few runs: their settings, their metrics under one protocol, and the analysis that draws them."""

from __future__ import annotations

from slamhive.services.run_comparison.figures import analysis_text, plots_of
from slamhive.services.run_comparison.model import (
    MOST_RUNS,
    CommonProtocol,
    Figure,
    MetricLine,
    RunColumn,
    RunComparison,
    SettingLine,
    read_run_ids,
)
from slamhive.services.run_comparison.service import RunComparisons
from slamhive.services.run_comparison.settings import settings_of

__all__ = [
    "MOST_RUNS",
    "CommonProtocol",
    "Figure",
    "MetricLine",
    "RunColumn",
    "RunComparison",
    "RunComparisons",
    "SettingLine",
    "analysis_text",
    "plots_of",
    "read_run_ids",
    "settings_of",
]
