"""How an algorithm and a dataset fit together, as JSON."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field

from slamhive.domain.matching import Match as Matched
from slamhive.domain.matching import Origin
from slamhive.domain.parameters import Value
from slamhive.domain.sensors import SensorKind
from slamhive.schema.fields import described
from slamhive.schema.model import Document


class UsedSensor(Document):
    """The sensor in a role, as the run sees it."""

    name: str
    kind: SensorKind
    topic: str
    rate_hz: Annotated[float, described("Messages per second.", unit="Hz")]
    fitting: Annotated[tuple[str, ...], described("All sensors of the dataset that fit the role.")]


class BoundParameter(Document):
    """A parameter that is taken from a sensor unless the user sets it."""

    value: Value
    source: Annotated[str, described("The property, for instance left.fx.")]
    sensors: Annotated[tuple[str, ...], described("The sensors that it belongs to.")]
    origin: Annotated[Origin, described("Where the value comes from: the sensor, the package's default, or the user.")]
    found: Annotated[Value | None, described("What the dataset has; null if nothing.")]
    words: Annotated[str, described("Where the value comes from, for people.")]


class Match(Document):
    """Which sensor serves which role, and the parameters that are taken from them."""

    sensors: dict[str, UsedSensor]
    parameters: dict[str, BoundParameter]
    topics: Annotated[dict[str, str], described("How the messages of each role reach the algorithm, for people.")] = (
        Field(default_factory=dict)
    )

    @classmethod
    def of_match(cls, match: Matched) -> Self:
        """The document of a match."""
        return cls(
            sensors={
                role: UsedSensor.of(sensor, fitting=[entry.name for entry in match.fitting[role]])
                for role, sensor in match.sensors.items()
            },
            parameters={entry.key: BoundParameter.of(entry) for entry in match.bound},
            topics={entry.role: entry.words for entry in match.remaps},
        )
