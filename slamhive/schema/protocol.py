"""Evaluation protocols as JSON: presets, those in use, and the metrics of published tools side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, PlainSerializer
from typing_extensions import TypedDict

from slamhive.domain.metrics import described as metric_of
from slamhive.domain.protocol import Protocol, protocol_from_content
from slamhive.schema.fields import described
from slamhive.schema.model import Document


def _protocol(raw: Any) -> Any:
    return protocol_from_content(raw) if isinstance(raw, dict) else raw


StatedProtocol = Annotated[Protocol, BeforeValidator(_protocol), PlainSerializer(lambda protocol: protocol.content)]
"""A protocol: its first four fields, and all others that differ from the default."""


class Preset(Document):
    """How one published tool evaluates."""

    name: str
    title: str
    fingerprint: str
    values: StatedProtocol
    figures: Annotated[tuple[str, ...], described("Metrics that the tool prints, the most important first.")]
    differs: Annotated[str, described("How it differs from other tools, and from SLAM Hive.")]
    source: Annotated[str, described("Where the tool is published.")]


class UsedProtocol(Document):
    """A protocol that runs were evaluated under."""

    fingerprint: str
    label: str
    values: StatedProtocol
    runs: int


class Protocols(Document):
    """All protocols that are known by name or in use."""

    presets: tuple[Preset, ...]
    used: tuple[UsedProtocol, ...]


class ToolMetric(TypedDict):
    """One metric that a tool prints. ``over``: how many pairs or segments it comes from, in words."""

    value: float
    unit: str
    over: str | None


class ToolMetrics(Document):
    """The metrics of a run as one published tool computes them."""

    name: str
    title: str
    protocol: StatedProtocol | None = Field(description="Null if the preset does not fit the run.")
    fingerprint: str | None
    figures: dict[str, ToolMetric]
    note: Annotated[str | None, described("Why metrics are missing.")]
    differs: str


def with_units(values: Mapping[str, float], samples: Mapping[str, str]) -> dict[str, ToolMetric]:
    """The metrics of one tool; ``samples`` says how many pairs or segments are behind them."""
    return {
        key: {"value": value, "unit": metric_of(key).unit, "over": samples.get(key)} for key, value in values.items()
    }
