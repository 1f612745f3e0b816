"""Definition of a metric."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from slamhive.domain.names import plural


class Direction(StrEnum):
    """Direction in which a metric is better."""

    LOWER = "lower"
    HIGHER = "higher"
    NEUTRAL = "neutral"


class Group(StrEnum):
    """Groups of metrics, in the order in which pages and lists show them."""

    ABSOLUTE = "absolute error"
    RELATIVE = "relative error"
    SEGMENTS = "segment error"
    DRIFT = "drift and scale"
    COMPLETENESS = "completeness"
    CONSISTENCY = "consistency"
    RELATIONS = "relations"
    MAP = "map quality"
    USAGE = "resources"
    TIMING = "timing"
    MACHINE = "disturbance"
    OTHER = "other"


@dataclass(frozen=True, slots=True)
class Metric:
    """The meaning of one metric.

    Attributes:
        key: Its name in files, filters and commands.
        label: Its name on pages.
        unit: Of the stored value; empty for a pure number.
        direction: Which way is better.
        definition: What it is, in one sentence or a few.
        needs_protocol: It comes from an evaluation, and so depends on the protocol. Others are measured during the run.
        group: Where pages show it.
        source: The paper, program or device that defines it.
        counted_by: Key of the metric that counts its pairs or segments; empty for none.
    """

    key: str
    label: str
    unit: str
    direction: Direction
    definition: str
    needs_protocol: bool = True
    group: Group = Group.OTHER
    source: str = ""
    counted_by: str = ""

    def sample(self, values: Mapping[str, float]) -> str:
        """The number of its pairs or segments in a run with ``values``: ``3,271 segments``; empty for none."""
        number = values.get(self.counted_by)
        if number is None:
            return ""
        return plural(int(number), "pair" if self.group is Group.RELATIVE else "segment")


STATISTICS = {
    "rmse": "root mean square",
    "mean": "mean",
    "median": "median",
    "std": "standard deviation (divisor n)",
    "min": "minimum",
    "max": "maximum",
    "sse": "sum of squares",
}
"""The statistics of an error, by the last part of the key, in words."""


def statistics(base: Metric, names: tuple[str, ...]) -> list[Metric]:
    """One metric for each statistic in ``names`` of the errors that the definition of ``base`` describes.

    A sum grows with the number of poses, so no direction of it is better.
    """
    return [
        replace(
            base,
            key=f"{base.key}.{name}",
            label=f"{base.label} {name.upper() if name in ('rmse', 'sse') else name}",
            unit=f"{base.unit}²" if name == "sse" else base.unit,
            direction=Direction.NEUTRAL if name == "sse" else base.direction,
            definition=f"{STATISTICS[name].capitalize()} of {base.definition}.",
        )
        for name in names
    ]


def higher(metric: Metric) -> Metric:
    """The same metric, for which higher is better."""
    return replace(metric, direction=Direction.HIGHER)


def neutral(metric: Metric) -> Metric:
    """The same metric, for which neither direction is better."""
    return replace(metric, direction=Direction.NEUTRAL)
