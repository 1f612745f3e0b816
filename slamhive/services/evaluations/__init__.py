"""Evaluations: protocols, the queue, and the metrics of a run under each protocol."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.evaluations.current import (
        NOT_EVALUATED,
        Comparisons,
        CurrentProtocols,
        Together,
        ToolFigures,
    )
    from slamhive.services.evaluations.protocols import (
        SENSOR_FRAME,
        ProtocolService,
        UsedProtocol,
        fitting_protocol,
        preset_documents,
        presets,
        protocol_for,
        protocols_document,
    )
    from slamhive.services.evaluations.service import (
        NO_ENGINE,
        PROTOCOL_FILE,
        Evaluations,
        ProtocolSearches,
        evaluation_notes,
        protocols_of_all,
        scratch_folder,
        sweep_scratch,
    )


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
