"""The names of filters: columns of runs and configurations, metrics, parameters, attributes of algorithms."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum

from slamhive.base.errors import nearest
from slamhive.domain.accounts import Visibility
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.dataset import ATTRIBUTE_KINDS
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.protocol import TrajectoryKind
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.sensors import SensorSetup
from slamhive.domain.trust import DisturbanceKind, TrustLevel
from slamhive.domain.verdict import GROUPS as VERDICT_GROUPS
from slamhive.domain.verdict import VerdictKind


class FieldKind(StrEnum):
    """The kind of values of a field, which decides the signs that may follow."""

    NUMBER = "number"
    TEXT = "text"
    CHOICE = "choice"
    TIME = "time"
    FLAG = "yes or no"


class Source(StrEnum):
    """Where a field's value is found."""

    RUN = "run"
    CONFIGURATION = "configuration"
    METRIC = "metric"
    MEAN = "mean"
    """A metric's mean over the runs of a configuration, where runs are grouped."""
    PARAMETER = "parameter"
    SETUP = "setup"
    ATTRIBUTE = "attribute"
    PROTOCOL = "protocol"
    VERDICT = "verdict"
    TRUST = "trust"
    NOTE = "note"


OF_CONFIGURATIONS = frozenset({Source.CONFIGURATION, Source.SETUP, Source.ATTRIBUTE, Source.PARAMETER})
"""Sources that all runs of a configuration share."""


@dataclass(frozen=True, slots=True)
class Field:
    """One name of the language.

    ``groups`` says which algorithms (for the sensors) or datasets (for attributes) have which value; for the verdict
    and the trust, which kinds a choice stands for.
    """

    name: str
    label: str
    kind: FieldKind
    source: Source
    unit: str = ""
    help: str = ""
    choices: tuple[str, ...] = ()
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict, compare=False, hash=False)


def _run(name: str, label: str, kind: FieldKind, note: str = "", choices: Iterable[str] = ()) -> Field:
    return Field(name, label, kind, Source.RUN, help=note, choices=tuple(map(str, choices)))


def _configuration(name: str, label: str, kind: FieldKind, note: str = "", choices: Iterable[str] = ()) -> Field:
    return Field(name, label, kind, Source.CONFIGURATION, help=note, choices=tuple(map(str, choices)))


SENSOR = Field(
    "sensor",
    "Sensors",
    FieldKind.CHOICE,
    Source.SETUP,
    help="what the algorithm senses with",
    choices=tuple(map(str, SensorSetup)),
)
ATTRIBUTES: dict[str, Field] = {
    name: Field(name, label, FieldKind.CHOICE, Source.ATTRIBUTE, help=note)
    for name, label, note in (
        ("attribute", "Attribute", "any word that describes the dataset"),
        *((kind.name, kind.label, f"of the dataset: {', '.join(kind.values)}") for kind in ATTRIBUTE_KINDS),
    )
}
"""The attributes of datasets. A parameter of the same name comes first, because filters have used it before."""
NOTES: dict[str, Field] = {
    entry.name: entry
    for entry in (
        Field("tag", "Tag", FieldKind.TEXT, Source.NOTE, help="a tag that somebody gave the run"),
        Field("note", "Note", FieldKind.TEXT, Source.NOTE, help="what somebody wrote about the run"),
    )
}
"""What people wrote about runs. A parameter of the same name comes first here too."""
PROTOCOL = Field(
    "protocol",
    "Protocol",
    FieldKind.TEXT,
    Source.PROTOCOL,
    help="fingerprint of the protocol whose metrics count; once only",
)
VERDICT = Field(
    "verdict",
    "Verdict",
    FieldKind.CHOICE,
    Source.VERDICT,
    help="good, or why the run counts as failed; 'failed' and 'diverged' stand for several; a lost run has none",
    choices=(*map(str, VerdictKind), *VERDICT_GROUPS),
    groups={**{str(kind): (str(kind),) for kind in VerdictKind}, **VERDICT_GROUPS},
)
TRUST = Field(
    "trust",
    "Trust",
    FieldKind.CHOICE,
    Source.TRUST,
    help="how far the measurements can be trusted; 'doubtful' stands for limited and low",
    choices=(*map(str, TrustLevel), "doubtful"),
    groups={**{str(level): (str(level),) for level in TrustLevel}, "doubtful": ("limited", "low")},
)
BUILT_IN: dict[str, Field] = {
    entry.name: entry
    for entry in (
        _run("id", "Run", FieldKind.NUMBER, "the run's number"),
        _configuration("algorithm", "Algorithm", FieldKind.TEXT, "mode of a package"),
        _configuration("package", "Package", FieldKind.TEXT, "folder of the algorithm"),
        SENSOR,
        _run("version", "Version", FieldKind.NUMBER, "number of the package's version that ran: algorithm = NAME@2"),
        _configuration("dataset", "Dataset", FieldKind.TEXT),
        _run("state", "State", FieldKind.CHOICE, "where the run is in its life", RunState),
        _run("reason", "Reason", FieldKind.CHOICE, "why a run failed", FailureReason),
        VERDICT,
        TRUST,
        _run("executor", "Executor", FieldKind.TEXT, "docker, process, ..."),
        _run("owner", "Owner", FieldKind.TEXT, "account that the run belongs to; me is your own"),
        _run("visibility", "Visibility", FieldKind.CHOICE, "who may see the run", Visibility),
        _run("experiment", "Experiment", FieldKind.TEXT, "name of the experiment that asked for the run"),
        _run("configuration", "Configuration", FieldKind.NUMBER, "number shared by all repeats"),
        _run(
            "trajectory",
            "Trajectory",
            FieldKind.CHOICE,
            "which trajectory the run gives as its main one",
            TrajectoryKind,
        ),
        _configuration("playback", "Playback", FieldKind.CHOICE, "how the recording was fed", PlaybackMode),
        _configuration("rate", "Playback rate", FieldKind.NUMBER, "1 is real time"),
        _configuration("variant", "Variant", FieldKind.FLAG, "whether the recording went through pre-processing"),
        _configuration("map", "Map", FieldKind.FLAG, "whether the algorithm started with the map of another run"),
        _run("evaluated", "Evaluated", FieldKind.FLAG, "whether an evaluation succeeded"),
        _run(
            "disturbed", "Disturbed", FieldKind.FLAG, "whether the machine was disturbed meanwhile, where that is known"
        ),
        _run("disturbed_by", "Disturbed by", FieldKind.CHOICE, "what disturbed the machine", DisturbanceKind),
        _run("seed", "Seed", FieldKind.NUMBER),
        _run("priority", "Priority", FieldKind.NUMBER),
        replace(_run("cpu_cores", "CPU limit", FieldKind.NUMBER, "that the run asked for"), unit="cores"),
        replace(_run("memory_mb", "Memory limit", FieldKind.NUMBER, "that the run asked for"), unit="MB"),
        _run("slow_down", "Slowed down", FieldKind.NUMBER, "1 is not slowed down"),
        _run("exit_code", "Exit code", FieldKind.NUMBER),
        _run("created_at", "Created", FieldKind.TIME),
        _run("started_at", "Started", FieldKind.TIME),
        _run("ended_at", "Ended", FieldKind.TIME),
        PROTOCOL,
    )
}
PARAMETER_PREFIX = "parameter."
"""Prefix of a parameter whose name something else has too: ``parameter.seed``."""

VARIANT_PREFIX = "variant."
"""Prefix of kind and option of a pre-processing step: ``variant.resolution.scale``."""


def metric_field(key: str) -> Field:
    """The field of a metric."""
    metric = CATALOGUE[key]
    return Field(key, metric.label, FieldKind.NUMBER, Source.METRIC, metric.unit, metric.definition)


@dataclass(frozen=True, slots=True)
class ParameterKind:
    """A parameter as some package defines it; packages may define the same name differently."""

    name: str
    kind: FieldKind
    unit: str = ""
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """The names that a filter may use besides the built-in ones.

    ``parameters`` by key and by general name, each with every way in which it is defined; ``own_keys`` are the keys
    behind each general name; ``sensors`` says which algorithms use which sensors, ``attributes`` which datasets have
    which attribute. ``protocols`` are all that metrics were computed under, {fingerprint: label}. ``me`` is the account
    that asks, empty for none.
    """

    parameters: Mapping[str, tuple[ParameterKind, ...]] = field(default_factory=dict)
    sensors: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    protocols: Mapping[str, str] = field(default_factory=dict)
    own_keys: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    attributes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    me: str = ""

    def fields(self, name: str) -> tuple[Field, ...]:
        """All meanings of ``name`` (parameters may have several kinds); empty if it has none."""
        if name == SENSOR.name:
            return (replace(SENSOR, groups=self.sensors),)
        if name in BUILT_IN:
            return (BUILT_IN[name],)
        if name in CATALOGUE:
            return (metric_field(name),)
        key = name.removeprefix(PARAMETER_PREFIX)
        parameters = tuple(
            Field(key, key, entry.kind, Source.PARAMETER, entry.unit, choices=entry.choices)
            for entry in self.parameters.get(key, ())
        )
        if name in ATTRIBUTES:
            return (*parameters, attribute_field(ATTRIBUTES[name], self.attributes))
        return (*parameters, NOTES[name]) if name in NOTES else parameters

    def names(self) -> Sequence[str]:
        """Every name that may begin a comparison."""
        return [*BUILT_IN, *ATTRIBUTES, *NOTES, *CATALOGUE, *self.parameters]

    def nearest(self, name: str) -> str:
        """A remedy for a name that has no meaning. The beginning of a key, such as ``ate``, means its metric."""
        begun = [key for key in CATALOGUE if key.startswith(f"{name}.")]
        if begun:
            return f"did you mean {next((key for key in begun if key.endswith('.rmse')), begun[0])!r}?"
        found = nearest(name, list(self.names()))
        return found if found.startswith("did you") else "docs/search.md lists what a filter can name"


def attribute_field(entry: Field, attributes: Mapping[str, tuple[str, ...]]) -> Field:
    """An attribute, or a property that attributes are values of, with the datasets that have each value."""
    kinds = {kind.name: kind.values for kind in ATTRIBUTE_KINDS}
    choices = kinds.get(entry.name) or tuple(sorted(attributes))
    return replace(entry, choices=choices, groups={value: attributes.get(value, ()) for value in choices})


def vocabulary_of(kinds: Iterable[ParameterKind], **others: Mapping[str, object] | str) -> Vocabulary:
    """A vocabulary of these parameters; definitions that are equal for searching are merged."""
    by_name: dict[str, dict[ParameterKind, None]] = {}
    for entry in kinds:
        by_name.setdefault(entry.name, {})[entry] = None
    return Vocabulary({name: tuple(entries) for name, entries in by_name.items()}, **others)  # type: ignore[arg-type]


# Numbers, units and times as users type them in filters.


_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", re.ASCII)
_NUMBER_AND_UNIT = re.compile(rf"({_NUMBER.pattern})\s*(\S*)", re.ASCII)
_DAY = re.compile(r"\d{4}-\d\d-\d\d", re.ASCII)
_MOMENT = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d{1,6})?)?(Z|[+-]\d\d:\d\d)?", re.ASCII)

_SCALES: dict[str, dict[str, float]] = {
    "s": {"us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0},
    "m": {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3},
    "bytes": {
        "bytes": 1.0,
        "B": 1.0,
        "kB": 1e3,
        "MB": 1e6,
        "GB": 1e9,
        "TB": 1e12,
        "KiB": 2.0**10,
        "MiB": 2.0**20,
        "GiB": 2.0**30,
    },
    "rad": {"rad": 1.0, "deg": math.pi / 180, "°": math.pi / 180},
    "deg": {"deg": 1.0, "°": 1.0, "rad": 180 / math.pi},
    "": {"%": 0.01},
    "Hz": {"Hz": 1.0, "kHz": 1e3},
    "MB": {"kB": 1e-3, "MB": 1.0, "GB": 1e3},
    "cores": {"cores": 1.0, "core": 1.0},
}
"""{unit a metric is stored in: {unit that may be typed: factor to the stored one}}."""

UNITS = frozenset(unit for scales in _SCALES.values() for unit in scales) | {"%"}
"""Words that are read as a unit after a number."""


def is_number(text: str) -> bool:
    """Tell if ``text`` is a plain number."""
    return _NUMBER.fullmatch(text) is not None


def units_of(stored: str) -> dict[str, float]:
    """The units in which a metric stored in ``stored`` can be compared, with their factors."""
    return _SCALES.get(stored, {stored: 1.0} if stored else {})


def number(text: str, stored_unit: str) -> float | None:
    """``text`` (``0.1``, ``1e-3``, ``50 ms``) in ``stored_unit``; None if it is no such number."""
    match = _NUMBER_AND_UNIT.fullmatch(text)
    if match is None:
        return None
    factor = 1.0 if not match[2] else units_of(stored_unit).get(match[2])
    if factor is None:
        return None
    value = float(match[1])
    value = value if factor == 1.0 else value * factor
    return value if math.isfinite(value) else None


def moments(text: str) -> tuple[datetime, datetime] | None:
    """The first moment of what ``text`` names, a UTC day or one microsecond, and the first after it; or None."""
    try:
        if _DAY.fullmatch(text):
            day = datetime.fromisoformat(text).replace(tzinfo=UTC)
            return day, day + timedelta(days=1)
        if _MOMENT.fullmatch(text):
            at = datetime.fromisoformat(text)
            at = at.replace(tzinfo=UTC) if at.tzinfo is None else at.astimezone(UTC)
            return at, at + timedelta(microseconds=1)
    except (ValueError, OverflowError):
        return None
    return None
