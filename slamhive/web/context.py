"""What views and templates reach for: the services and the live hub of this application."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, cast

from flask import current_app

if TYPE_CHECKING:
    from slamhive.services.hive import Hive
    from slamhive.web.live import LiveHub
    from slamhive.web.variant_maker import VariantMaker

EXTENSION = "slamhive"
LIVE_EXTENSION = "slamhive-live"
VARIANTS_EXTENSION = "slamhive-variants"


def hive() -> Hive:
    """The services of this application."""
    return cast("Hive", current_app.extensions[EXTENSION])


def live_hub() -> LiveHub:
    """The live hub of this application."""
    return cast("LiveHub", current_app.extensions[LIVE_EXTENSION])


def variant_maker() -> VariantMaker:
    """What makes variants for the pages of this application."""
    return cast("VariantMaker", current_app.extensions[VARIANTS_EXTENSION])


def now() -> datetime:
    """The current time in UTC."""
    return datetime.now(UTC)
