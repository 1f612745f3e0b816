"""The words that describe a dataset, such as ``indoor`` or ``dark``, and the properties that they are values of."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class AttributeKind:
    """A property of datasets and its known values. A dataset that names none of them has no value."""

    name: str
    label: str
    values: tuple[str, ...]

    def of(self, attributes: Iterable[str]) -> str | None:
        """The stated value, or ``indoor + outdoor`` for two; None if ``attributes`` state none."""
        given = set(attributes)
        return " + ".join(value for value in self.values if value in given) or None


ATTRIBUTE_KINDS = (
    AttributeKind("place", "Place", ("indoor", "outdoor", "underground")),
    AttributeKind("motion", "Motion", ("static", "slow", "moderate", "fast")),
    AttributeKind("light", "Light", ("bright", "changing-light", "dark")),
    AttributeKind("loops", "Loops", ("loops", "no-loops")),
    AttributeKind("difficulty", "Difficulty", ("easy", "medium", "difficult")),
    AttributeKind("scene", "Scene", ("static-scene", "dynamic-scene")),
    AttributeKind("carrier", "Carrier", ("handheld", "robot", "drone", "car")),
    AttributeKind("origin", "Origin", ("real", "synthetic")),
)
"""Every further word is an attribute too, but belongs to no property."""
