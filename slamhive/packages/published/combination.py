"""Combination files of the published SLAM Hive, as their authors keep them: text to copy into its web form.

A combination has a title (``algorithm+dataset+purpose``), a description, lines of template numbers that change
together, and new values for each factor of a rate or a resolution. Lines of dashes separate the four.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput

# Files of the published SLAM Hive hold YAML among prose and other documents, with lines of dashes between them.


_SEPARATOR = re.compile(r"-{3,}\s*$")

Part = tuple[int, int]
"""The first line of a part, from 0, and the line after its last."""


def parts_of(lines: Sequence[str]) -> list[Part]:
    """The parts between lines of dashes; an empty part has equal numbers."""
    dashes = [number for number, line in enumerate(lines) if _SEPARATOR.match(line)]
    return [(before + 1, after) for before, after in pairwise([-1, *dashes, len(lines)])]


def only(lines: Sequence[str], part: Part) -> str:
    """The text of one part. All other lines are empty, so that messages name the lines of the file."""
    first, last = part
    return "\n".join(line if first <= number < last else "" for number, line in enumerate(lines))


_TITLE = re.compile(r"[\w.-]+\+[\w.-]+\+[\w.+-]+")
_TIE = re.compile(r"\d+(?:\s*,\s*\d+)+")
_VALUES = re.compile(r"\d+\s*:\s*$")
_RANGE = re.compile(r"(?P<name>[A-Za-z][\w. ]*?)\s*:\s*(?P<values>[^|\s][^|]*(?:\|[^|]+)+)")
_NAMED = re.compile(r"(?P<key>Algorithm|Dataset)\s*:\s*(?P<name>[\w.-]+)\s*")
_TOTAL = re.compile(r"Totall?y?\s*:(?:.*=)?.*?(\d{1,9})\D*", re.IGNORECASE)

_LARGEST_FACTOR = 1e6

Factors = dict[float, dict[str, Any]]
"""New values by the number of their template, for each factor."""


@dataclass(frozen=True, slots=True)
class Range:
    """A line of the description that lists values: ``nFeatures: 1000 | 2000``; ``line`` counts from 1."""

    name: str
    values: tuple[str, ...]
    line: int


@dataclass(slots=True)
class Combination:
    """One combination.

    ``line`` is that of its title. ``tied`` holds template numbers that change together, ``changes`` the factors of each
    template, with ``places`` for messages. ``prose`` is other text after the description, with its lines.
    ``described``: the description has been read.
    """

    title: str
    line: int
    algorithm: str
    dataset: str
    description: list[str] = field(default_factory=list)
    ranges: list[Range] = field(default_factory=list)
    total: int | None = None
    tied: list[tuple[str, ...]] = field(default_factory=list)
    changes: dict[str, Factors] = field(default_factory=dict)
    places: strict_yaml.Places = field(default_factory=lambda: strict_yaml.Places("", {}))
    prose: list[tuple[int, str]] = field(default_factory=list)
    described: bool = False


def is_combination(text: str) -> bool:
    """Return whether a text holds the title of a combination between lines of dashes."""
    lines = text.splitlines()
    parts = (list(_written(lines, part)) for part in parts_of(lines))
    return any(len(written) == 1 and _TITLE.fullmatch(written[0][1].strip()) for written in parts)


def read_combinations(text: str, source: str) -> tuple[list[Combination], list[tuple[int, str]]]:
    """The combinations in a file, and the lines before the first one.

    Raises InvalidInput, with the line, if there is none, or if one contradicts itself or cannot be read.
    """
    lines = text.splitlines()
    found: list[Combination] = []
    before: list[tuple[int, str]] = []
    for part in parts_of(lines):
        written = list(_written(lines, part))
        if len(written) == 1 and _TITLE.fullmatch(written[0][1].strip()):
            title = written[0][1].strip()
            algorithm, dataset, *_ = title.split("+")
            found.append(Combination(title, written[0][0], algorithm, dataset))
        elif not found:
            before += written
        else:
            _Reader(found[-1], lines, source).read(part)
    if not found:
        raise InvalidInput(
            f"{source} holds no combination of the published SLAM Hive",
            "one begins with ALGORITHM+DATASET+PURPOSE between two lines of dashes",
        )
    return found, before


def _written(lines: Sequence[str], part: Part) -> Iterator[tuple[int, str]]:
    """The lines of a part that are not empty, with their numbers from 1."""
    return ((number + 1, lines[number].rstrip()) for number in range(*part) if lines[number].strip())


class _Reader:
    """Reads the parts of one combination into it."""

    def __init__(self, combination: Combination, lines: Sequence[str], source: str) -> None:
        self._into = combination
        self._lines = lines
        self._source = source

    def read(self, part: Part) -> None:
        """Read a part, whichever of the three it is."""
        described = not self._into.described
        self._into.described = True
        values = next((number for number in range(*part) if _VALUES.match(self._lines[number])), part[1])
        for number, line in _written(self._lines, (part[0], values)):
            self._text(number, line, described=described)
        if values < part[1]:
            self._values((values, part[1]))

    def _text(self, number: int, line: str, *, described: bool) -> None:
        into, stripped = self._into, line.strip()
        if _TIE.fullmatch(stripped):
            into.tied.append(tuple(entry.strip() for entry in stripped.split(",")))
        elif named := _NAMED.fullmatch(stripped):
            self._check_name(number, named["key"].lower(), named["name"])
        elif ranged := _RANGE.fullmatch(stripped):
            values = tuple(value.strip() for value in ranged["values"].split("|"))
            into.ranges.append(Range(ranged["name"].strip(), values, number))
        elif total := _TOTAL.fullmatch(stripped):
            into.total = int(total[1])
        elif described:
            into.description.append(stripped)
        else:
            into.prose.append((number, line))

    def _check_name(self, number: int, key: str, name: str) -> None:
        titled = self._into.algorithm if key == "algorithm" else self._into.dataset
        if name != titled:
            raise InvalidInput(
                f"{self._source}, line {number}: the {key} is {name}, but the title in line {self._into.line} says "
                f"{titled}",
                "write the same in both",
            )

    def _values(self, part: Part) -> None:
        if self._into.changes:
            raise InvalidInput(
                f"{self._source}, line {part[0] + 1}: new values for {self._into.title} again", "write them once"
            )
        content, lines = strict_yaml.parse_with_lines(only(self._lines, part), self._source)
        self._into.places = strict_yaml.Places(self._source, lines)
        for number, entry in content.items():
            if not isinstance(entry, Mapping):
                raise InvalidInput(f"{self._into.places.of(number)}: {number} needs factors with new values")
            factors = self._into.changes[number] = {}
            for text, values in entry.items():
                try:
                    factor = float(text)
                except ValueError:
                    factor = 0.0
                if not 0 < factor < _LARGEST_FACTOR or not isinstance(values, Mapping | None):
                    place = self._into.places.of(number, text)
                    raise InvalidInput(f"{place}: expected a factor with new values, found {text}: {values!r}")
                factors[factor] = dict(values or {})


# What the numbers of parameter templates mean in the combination files of the published SLAM Hive.
#
# Its files name parameters by the numbers that they have in the database of its authors. A number is believed only if
# the values beside it look like what it means; users name others with ``--id``.


RATE, RESOLUTION = "rate", "resolution"

_AXES = {
    "588": "image0_frequency",
    "602": "image1_frequency",
    "589": "imu_frequency",
    "591": "image0_resolution",
    "603": "image1_resolution",
}
_NAMES_OF_TEMPLATES = {
    "350": "image_frequency",
    "351": "image_width",
    "352": "image_height",
    "436": "fx",
    "437": "fy",
    "438": "cx",
    "439": "cy",
    "448": "bf",
    "449": "ThDepth",
    "454": "LEFT_D",
    "455": "LEFT_K",
    "456": "LEFT_R",
    "457": "LEFT_P",
    "571": "RIGHT_D",
    "572": "RIGHT_K",
    "573": "RIGHT_R",
    "574": "RIGHT_P",
    "575": "imu_frequency",
    "620": "cam1_fx",
    "621": "cam1_fy",
    "622": "cam1_cx",
    "623": "cam1_cy",
}
RECTIFICATION = frozenset({"left_r", "left_p", "right_r", "right_p"})
"""Matrices that follow from intrinsics and extrinsics; packages compute them."""
RATES = frozenset({"image_frequency", "imu_frequency"})
WIDTH = "image_width"

_KINDS_OF_CHANGES = {"frequency": RATE, "resolution": RESOLUTION}
_AXIS = re.compile(r"(?P<sensor>[a-z]+?)(?P<place>\d?)_(?P<kind>frequency|resolution)")


@dataclass(frozen=True, slots=True)
class ChangedValue:
    """Meaning of a number before a block of factors: the rate or the resolution of one sensor.

    ``sensor`` is ``image``, ``imu``, ``lidar`` ...; ``place`` counts the images, from 0.
    """

    sensor: str
    place: int
    kind: str

    @property
    def words(self) -> str:
        """``the resolution of image 1``."""
        return f"the {self.kind} of {self.sensor} {self.place}" if self.sensor == "image" else f"the {self.sensor} rate"


def changed(number: str, meanings: dict[str, str]) -> ChangedValue | None:
    """The meaning of a number that has factors; None if nobody knows it."""
    found = _AXIS.fullmatch(meanings.get(number) or _AXES.get(number) or "")
    if found is None:
        return None
    return ChangedValue(found["sensor"], int(found["place"] or 0), _KINDS_OF_CHANGES[found["kind"]])


def value_name(number: str, meanings: dict[str, str]) -> str | None:
    """The name of the parameter that a number stands for; None if nobody knows it."""
    return meanings.get(number) or _NAMES_OF_TEMPLATES.get(number)
