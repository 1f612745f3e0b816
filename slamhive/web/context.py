"""What views and templates reach for: the services and the live hub of this application."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from flask import current_app

if TYPE_CHECKING:
    from slamhive.services.hive import Hive
    from slamhive.web.analysis_computer import AnalysisComputer
    from slamhive.web.analysis_files import AnalysisFiles
    from slamhive.web.live import LiveHub
    from slamhive.web.rates import RateLimit
    from slamhive.web.variant_maker import VariantMaker

EXTENSION = "slamhive"
LIVE_EXTENSION = "slamhive-live"
VARIANTS_EXTENSION = "slamhive-variants"
COMPUTER_EXTENSION = "slamhive-analyses"
FILES_EXTENSION = "slamhive-analysis-files"
RATES_EXTENSION = "slamhive-rates"


def hive() -> Hive:
    """The services of this application."""
    return cast("Hive", current_app.extensions[EXTENSION])


def live_hub() -> LiveHub:
    """The live hub of this application."""
    return cast("LiveHub", current_app.extensions[LIVE_EXTENSION])


def variant_maker() -> VariantMaker:
    """What makes variants for the pages of this application."""
    return cast("VariantMaker", current_app.extensions[VARIANTS_EXTENSION])


def analysis_computer() -> AnalysisComputer | None:
    """What computes analyses in this process; None where a worker does."""
    return cast("AnalysisComputer | None", current_app.extensions[COMPUTER_EXTENSION])


def analysis_files() -> AnalysisFiles:
    """What makes files of analyses."""
    return cast("AnalysisFiles", current_app.extensions[FILES_EXTENSION])


def rate_limit(name: str) -> RateLimit:
    """How often visitors may ask for something."""
    return cast("dict[str, RateLimit]", current_app.extensions[RATES_EXTENSION])[name]
