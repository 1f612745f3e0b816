"""Replays: what a bundle recorded runs again, and is compared with the record."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.replay.answer import (
        CONFIGURATION_HEADS,
        METRIC_HEADS,
        VALUE_HEADS,
        answer_markdown,
        configuration_rows,
        metric_rows,
        value_rows,
    )
    from slamhive.services.replay.needs import ReplayRequest
    from slamhive.services.replay.service import Replays


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
