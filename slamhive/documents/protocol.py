"""Evaluation protocols as JSON: presets, those in use, and the metrics of published tools side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PlainSerializer
from typing_extensions import TypedDict

from slamhive.documents.model import Document, described
from slamhive.domain.metrics import Direction
from slamhive.domain.metrics import described as metric_of
from slamhive.domain.protocol import Protocol, protocol_from_content


def _protocol(raw: Any) -> Any:
    return protocol_from_content(raw) if isinstance(raw, dict) else raw


StatedProtocol = Annotated[Protocol, BeforeValidator(_protocol), PlainSerializer(lambda protocol: protocol.content)]
"""A protocol: its first four fields, and all others that differ from the default."""


class PresetDocument(Document):
    """Evaluation rules of one published tool."""

    name: str
    title: str
    fingerprint: str
    values: StatedProtocol
    figures: Annotated[tuple[str, ...], described("Metrics that the tool prints, the most important first.")]
    differs: Annotated[str, described("How it differs from other tools, and from SLAM Hive.")]
    source: Annotated[str, described("Where the tool is published.")]


class UsedProtocolDocument(Document):
    """A protocol that runs were evaluated under."""

    fingerprint: str
    label: str
    values: StatedProtocol
    runs: int


class ProtocolsDocument(Document):
    """All protocols that are known by name or in use."""

    presets: tuple[PresetDocument, ...]
    used: tuple[UsedProtocolDocument, ...]


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


class ProtocolMatchDocument(Document):
    """A protocol that gives a printed number."""

    preset: Annotated[str | None, described("Name of the tool whose rules these are; null if of none.")]
    fingerprint: str
    protocol: StatedProtocol
    words: Annotated[str, described("The protocol in words.")]
    key: Annotated[str, described("The metric.")]
    unit: Annotated[str, described("The unit in which it gives the number.")]
    value: Annotated[float, described("The metric in that unit, with all digits.")]
    rarity: Annotated[int, described("0 for what most papers use; larger is rarer.")]
    alike: Annotated[tuple[str, ...], described("Protocols with the same value, which cannot be told apart.")]


class ProtocolSearchDocument(Document):
    """Protocols under which a run gives a number that a paper prints, the most usual first."""

    run: int
    printed: Annotated[str, described("The number as it was given.")]
    metric: Annotated[str, described("What the paper calls it.")]
    tried: Annotated[int, described("Number of combinations that were tried.")]
    matches: tuple[ProtocolMatchDocument, ...]
    skipped: Annotated[dict[str, int], described("Why combinations could not be tried, and how many.")]


# A comparison of a few runs, as JSON.


class ComparedColumn(Document):
    """Content of one column."""

    runs: Annotated[tuple[int, ...], described("Its runs: one, or all repeats.")]
    failed: Annotated[tuple[int, ...], described("Those that count as failed.")]


class ComparedProtocol(Document):
    """A protocol under which some of the runs are evaluated."""

    fingerprint: str
    label: str
    runs: Annotated[tuple[int, ...], described("The runs that are evaluated under it.")]
    lacking: Annotated[tuple[int, ...], described("The runs that could be evaluated under it, but are not.")]


class ComparedValue(Document):
    """A metric of one column."""

    mean: Annotated[float, described("The mean over the runs, in the unit of the metric.")]
    count: Annotated[int, described("The number of runs that it was computed from.")]
    low: Annotated[float | None, described("Lower end of the 95 % interval of the mean; null for a single run.")]
    high: Annotated[float | None, described("Upper end of the 95 % interval of the mean; null for a single run.")]

    @property
    def shown(self) -> str:
        """The mean with the digits that decide on a tie."""
        return shown_digits(self.mean)


def shown_digits(value: float) -> str:
    """The three significant digits that pages show; values that agree in them are a tie."""
    return f"{value:.3g}"


class ComparedMetric(Document):
    """One metric of all columns."""

    unit: Annotated[str, described("Of the values; empty for none.")]
    better: Annotated[Direction, described("Which values are better.")]
    best: Annotated[str | None, described("The column with the best value; null if none is marked.")]
    values: Annotated[dict[str, ComparedValue | None], described("By column; null where the value is missing.")]


class ComparisonDocument(Document):
    """Runs side by side under one protocol. Columns are named by the number of the run, or of its configuration."""

    runs: Annotated[tuple[int, ...], described("All runs, in the order of the columns.")]
    group: Annotated[Literal["configuration"] | None, described("What a column stands for; null: one run.")]
    columns: dict[str, ComparedColumn]
    protocol: Annotated[ComparedProtocol | None, described("The one of the metrics; null if no run is evaluated.")]
    protocols: Annotated[tuple[ComparedProtocol, ...], described("All protocols that some of the runs have.")]
    mixed_trajectories: Annotated[
        dict[str, tuple[int, ...]],
        described("The runs by the kind of trajectory that was judged (live, final, keyframes), if several were."),
    ]
    settings: Annotated[dict[str, dict[str, str | None]], described("By name and column; null where a run has none.")]
    metrics: Annotated[dict[str, ComparedMetric], described("By key.")]
    unmarked: Annotated[
        str | None, described("Which metrics have no value marked as the best, and why; null for none.")
    ]
    not_comparable: Annotated[
        str | None,
        described("Where runs lack the protocol: how many runs use which one, and the remedy. Null if none lacks it."),
    ]
    sentences: Annotated[
        tuple[str, ...], described("How each group of repeats stands to the first one; empty for single runs.")
    ]
    address: Annotated[str, described("The path of the same comparison on the web pages.")]
