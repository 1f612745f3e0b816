"""What a metric is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from slamhive.domain.numbers import plural


class Direction(StrEnum):
    """Which way is better."""

    LOWER = "lower"
    HIGHER = "higher"
    NEUTRAL = "neutral"


class Group(StrEnum):
    """What a metric is about: the order in which pages and lists offer them."""

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


@dataclass(frozen=True, slots=True)
class Metric:
    """What one metric means.

    Attributes:
        key: What the metric is called everywhere.
        label: Its name on pages.
        unit: Of the stored value; empty for a pure number.
        direction: Which way is better.
        definition: What it is, in one sentence or a few.
        needs_protocol: It depends on association and alignment and comes from an evaluation; the others are measured
            while running.
        group: What it is about.
        source: Paper, program or measuring device it is defined by.
        counted_by: Key of the metric that says how many pairs or segments it is taken over; empty for none.
    """

    key: str
    label: str
    unit: str
    direction: Direction
    definition: str
    needs_protocol: bool
    group: Group
    source: str
    counted_by: str = ""

    def sample(self, values: Mapping[str, float]) -> str:
        """How many pairs or segments it is taken over, of a run with ``values``: ``3,271 segments``; empty for none."""
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
    """One metric for each statistic in ``names`` of the errors that the definition of ``base`` describes."""
    return [
        replace(
            base,
            key=f"{base.key}.{name}",
            label=f"{base.label} {name.upper() if name in ('rmse', 'sse') else name}",
            unit=f"{base.unit}²" if name == "sse" else base.unit,
            definition=f"{STATISTICS[name].capitalize()} of {base.definition}.",
        )
        for name in names
    ]


def higher(metric: Metric) -> Metric:
    """``metric`` as one of which more is better."""
    return replace(metric, direction=Direction.HIGHER)


def neutral(metric: Metric) -> Metric:
    """``metric`` as one of which neither more nor less is better."""
    return replace(metric, direction=Direction.NEUTRAL)
