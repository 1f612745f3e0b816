"""A comparison of a few runs, as JSON."""

from __future__ import annotations

from typing import Annotated, Literal

from slamhive.domain.metrics import Direction
from slamhive.schema.fields import described
from slamhive.schema.model import Document


class ComparedColumn(Document):
    """What one column holds."""

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


class ComparedMetric(Document):
    """One metric of all columns."""

    unit: Annotated[str, described("Of the values; empty for none.")]
    better: Annotated[Direction, described("Which values are better.")]
    best: Annotated[str | None, described("The column with the best value; null if none is marked.")]
    values: Annotated[dict[str, ComparedValue | None], described("By column; null where the value is missing.")]


class Comparison(Document):
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
    address: Annotated[str, described("The path of the same comparison on the web pages.")]
