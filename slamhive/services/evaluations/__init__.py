"""Evaluations: protocols, the queue, and the metrics of a run under each protocol."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.evaluations.comparisons import NOT_EVALUATED, Comparisons, ToolFigures
    from slamhive.services.evaluations.current import CurrentProtocols
    from slamhive.services.evaluations.documents import preset_documents, protocols_document
    from slamhive.services.evaluations.notes import evaluation_notes
    from slamhive.services.evaluations.protocols import Protocols, UsedProtocol, fitting_protocol, presets, protocol_for
    from slamhive.services.evaluations.scratch import scratch_folder, sweep_scratch
    from slamhive.services.evaluations.service import NO_ENGINE, PROTOCOL_FILE, Evaluations
    from slamhive.services.evaluations.trajectories import protocols_of_all

__all__ = [
    "NOT_EVALUATED",
    "NO_ENGINE",
    "PROTOCOL_FILE",
    "Comparisons",
    "CurrentProtocols",
    "Evaluations",
    "Protocols",
    "ToolFigures",
    "UsedProtocol",
    "evaluation_notes",
    "fitting_protocol",
    "preset_documents",
    "presets",
    "protocol_for",
    "protocols_document",
    "protocols_of_all",
    "scratch_folder",
    "sweep_scratch",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
