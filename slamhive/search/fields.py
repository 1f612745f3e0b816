"""The names of filters: columns of runs and configurations, metrics, parameters, attributes of algorithms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

from slamhive.domain.attributes import ATTRIBUTE_KINDS
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.disturbance import DisturbanceKind
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.sensors import SensorSetup
from slamhive.domain.trajectory_kind import TrajectoryKind
from slamhive.domain.trust import TrustLevel
from slamhive.domain.verdict import GROUPS as VERDICT_GROUPS
from slamhive.domain.verdict import VerdictKind
from slamhive.domain.visibility import Visibility
from slamhive.errors import nearest


class Kind(StrEnum):
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
    PARAMETER = "parameter"
    SETUP = "setup"
    ATTRIBUTE = "attribute"
    PROTOCOL = "protocol"
    VERDICT = "verdict"
    TRUST = "trust"
    NOTE = "note"


@dataclass(frozen=True, slots=True)
class Field:
    """One name of the language.

    ``groups`` says which algorithms (for the sensors) or datasets (for attributes) have which value; for the verdict
    and the trust, which kinds a choice stands for.
    """

    name: str
    label: str
    kind: Kind
    source: Source
    unit: str = ""
    help: str = ""
    choices: tuple[str, ...] = ()
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict, compare=False, hash=False)


def _run(name: str, label: str, kind: Kind, note: str = "", choices: Iterable[str] = ()) -> Field:
    return Field(name, label, kind, Source.RUN, help=note, choices=tuple(map(str, choices)))


def _configuration(name: str, label: str, kind: Kind, note: str = "", choices: Iterable[str] = ()) -> Field:
    return Field(name, label, kind, Source.CONFIGURATION, help=note, choices=tuple(map(str, choices)))


SENSOR = Field(
    "sensor",
    "Sensors",
    Kind.CHOICE,
    Source.SETUP,
    help="what the algorithm senses with",
    choices=tuple(map(str, SensorSetup)),
)
ATTRIBUTES: dict[str, Field] = {
    name: Field(name, label, Kind.CHOICE, Source.ATTRIBUTE, help=note)
    for name, label, note in (
        ("attribute", "Attribute", "any word that describes the dataset"),
        *((kind.name, kind.label, f"of the dataset: {', '.join(kind.values)}") for kind in ATTRIBUTE_KINDS),
    )
}
"""The attributes of datasets. A parameter of the same name comes first, because filters have used it before."""
NOTES: dict[str, Field] = {
    entry.name: entry
    for entry in (
        Field("tag", "Tag", Kind.TEXT, Source.NOTE, help="a tag that somebody gave the run"),
        Field("note", "Note", Kind.TEXT, Source.NOTE, help="what somebody wrote about the run"),
    )
}
"""What people wrote about runs. A parameter of the same name comes first here too."""
PROTOCOL = Field(
    "protocol",
    "Protocol",
    Kind.TEXT,
    Source.PROTOCOL,
    help="fingerprint of the protocol whose metrics count; once only",
)
VERDICT = Field(
    "verdict",
    "Verdict",
    Kind.CHOICE,
    Source.VERDICT,
    help="whether the run is good or why it counts as failed; 'failed' and 'diverged' stand for several reasons",
    choices=(*map(str, VerdictKind), *VERDICT_GROUPS),
    groups={**{str(kind): (str(kind),) for kind in VerdictKind}, **VERDICT_GROUPS},
)
TRUST = Field(
    "trust",
    "Trust",
    Kind.CHOICE,
    Source.TRUST,
    help="how far the measurements can be trusted; 'doubtful' stands for limited and low",
    choices=(*map(str, TrustLevel), "doubtful"),
    groups={**{str(level): (str(level),) for level in TrustLevel}, "doubtful": ("limited", "low")},
)
BUILT_IN: dict[str, Field] = {
    entry.name: entry
    for entry in (
        _run("id", "Run", Kind.NUMBER, "the run's number"),
        _configuration("algorithm", "Algorithm", Kind.TEXT, "mode of a package"),
        _configuration("package", "Package", Kind.TEXT, "folder of the algorithm"),
        SENSOR,
        _run("version", "Version", Kind.NUMBER, "number of the package's version that ran: algorithm = NAME@2"),
        _configuration("dataset", "Dataset", Kind.TEXT),
        _run("state", "State", Kind.CHOICE, "where the run is in its life", RunState),
        _run("reason", "Reason", Kind.CHOICE, "why a run failed", FailureReason),
        VERDICT,
        TRUST,
        _run("executor", "Executor", Kind.TEXT, "docker, process, ..."),
        _run("owner", "Owner", Kind.TEXT, "account that the run belongs to; me is your own"),
        _run("visibility", "Visibility", Kind.CHOICE, "who may see the run", Visibility),
        _run("experiment", "Experiment", Kind.TEXT, "name of the experiment that asked for the run"),
        _run("configuration", "Configuration", Kind.NUMBER, "number shared by all repeats"),
        _run("trajectory", "Trajectory", Kind.CHOICE, "which trajectory the run gives as its main one", TrajectoryKind),
        _configuration("playback", "Playback", Kind.CHOICE, "how the recording was fed", PlaybackMode),
        _configuration("rate", "Playback rate", Kind.NUMBER, "1 is real time"),
        _configuration("variant", "Variant", Kind.FLAG, "whether the recording went through pre-processing"),
        _configuration("map", "Map", Kind.FLAG, "whether the algorithm started with the map of another run"),
        _run("evaluated", "Evaluated", Kind.FLAG, "whether an evaluation succeeded"),
        _run("disturbed", "Disturbed", Kind.FLAG, "whether the machine was disturbed meanwhile, where that is known"),
        _run("disturbed_by", "Disturbed by", Kind.CHOICE, "what disturbed the machine", DisturbanceKind),
        _run("seed", "Seed", Kind.NUMBER),
        _run("priority", "Priority", Kind.NUMBER),
        _run("exit_code", "Exit code", Kind.NUMBER),
        _run("created_at", "Created", Kind.TIME),
        _run("started_at", "Started", Kind.TIME),
        _run("ended_at", "Ended", Kind.TIME),
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
    return Field(key, metric.label, Kind.NUMBER, Source.METRIC, metric.unit, metric.definition)


@dataclass(frozen=True, slots=True)
class ParameterKind:
    """A parameter as some package defines it; packages may define the same name differently."""

    name: str
    kind: Kind
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
