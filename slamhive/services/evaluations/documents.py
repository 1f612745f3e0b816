"""Protocols as JSON shows them."""

from __future__ import annotations

from collections.abc import Iterable

from slamhive.schema import protocol as schema
from slamhive.services.evaluations.protocols import UsedProtocol, presets


def preset_documents() -> dict[str, schema.Preset]:
    """The presets by name."""
    return {
        name: schema.Preset.of(
            preset,
            name=name,
            fingerprint=preset.protocol.fingerprint,
            values=preset.protocol,
            figures=preset.metrics,
        )
        for name, preset in presets()
    }


def protocols_document(used: Iterable[UsedProtocol]) -> schema.Protocols:
    """All presets, and the protocols in use."""
    return schema.Protocols(
        presets=tuple(preset_documents().values()),
        used=tuple(schema.UsedProtocol.of(entry.protocol, values=entry.protocol, runs=entry.runs) for entry in used),
    )
