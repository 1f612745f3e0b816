"""A request for runs. Commands, the web form, experiment files and the web API offer the fields defined here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Annotated, Any, ClassVar

from slamhive.base.errors import InvalidInput, unknown
from slamhive.documents.limits import RULES, Asked, RunOptions, StopWhen, options_of
from slamhive.domain.accounts import Visibility
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Configuration, InputMap, Playback, PlaybackMode, Variant
from slamhive.domain.parameters import Value, parse_settings
from slamhive.domain.protocol import Alignment

CONTENT = "content"
"""The group of the fields that make up a configuration."""
MAX_REPEATS = 1000

Executor = Annotated[str | None, Asked("Where runs are executed; by default the executor in force.")]
StartingMap = Annotated[
    str | None,
    Asked(
        "Number or uid of the run whose saved map the algorithm starts with, to find itself in it.",
        title="Start with the map of run",
        group=CONTENT,
    ),
]
RequestedAlignment = Annotated[
    Alignment | None,
    Asked("How the estimate is aligned to the ground truth; by default as the sensors require."),
]
SameCpu = Annotated[
    bool,
    Asked("All runs of the experiment are measured on one CPU model; false allows several.", title="Same CPU model"),
]

SeenBy = Annotated[
    Visibility | None,
    Asked("Who may see the runs, where there are accounts; by default as NEW_RUNS says.", title="Seen by"),
]

_RULE_PREFIX = "stop_when."


@dataclass(frozen=True, slots=True)
class Submission(RunOptions):
    """A request for one or more runs of one configuration.

    Commands and forms build it from text; :meth:`check` refuses values that are not allowed.
    """

    algorithm: Annotated[
        str, Asked("Name of the algorithm; NAME@2 is version 2 of its package, NAME the newest.", group=CONTENT)
    ]
    dataset: Annotated[str, Asked("Name of the dataset.", group=CONTENT)]
    parameters: Annotated[
        Mapping[str, Value],
        Asked(
            "Values of the algorithm's parameters, by key or general name; the others keep their defaults.",
            group=CONTENT,
        ),
    ] = field(default_factory=dict)
    repeat: Annotated[int, Asked("How many runs of this configuration.", ge=1, le=MAX_REPEATS)] = 1
    executor: Executor = None
    seed: Annotated[int, Asked("Seed of the first run; repeats get the next ones.", ge=0, le=2**31 - 1)] = 0
    playback_mode: Annotated[
        PlaybackMode,
        Asked("realtime: a slow algorithm loses frames; sequential: no frame is lost.", group=CONTENT),
    ] = PlaybackMode.REALTIME
    playback_rate: Annotated[
        float, Asked("Playback speed; 2.0 plays twice as fast.", group=CONTENT, ge=0.01, le=100)
    ] = 1.0
    alignment: RequestedAlignment = None
    variant: Annotated[Variant, Asked("Pre-processing steps of the dataset, in order.", group=CONTENT)] = ()
    sensors: Annotated[
        Mapping[str, str],
        Asked(
            "The sensor for a role, where several fit; the other roles follow the order of the dataset.", group=CONTENT
        ),
    ] = field(default_factory=dict)
    map: StartingMap = None
    visibility: SeenBy = None

    __pydantic_config__: ClassVar[dict[str, Any]] = {
        "extra": "forbid",
        "allow_inf_nan": False,
        "title": "SLAM Hive submission",
    }
    """How documents are read and described; pydantic itself is not loaded for it."""

    def configuration(self, algorithm: Algorithm, input_map: InputMap | None = None) -> Configuration:
        """The checked configuration, its variant as it was given; raises NotFound or InvalidInput naming the value.

        ``input_map`` is what ``map`` names.
        """
        playback = Playback(PlaybackMode(self.playback_mode), self.playback_rate)
        algorithm.package.check_playback(playback)
        return Configuration(
            algorithm=algorithm.name,
            dataset=self.dataset,
            parameters=parse_settings(algorithm.name, algorithm.parameters, self.parameters),
            playback=playback,
            variant=self.variant,
            sensors=self.sensors,
            version=algorithm.version,
            map=input_map,
        )

    def check(self) -> None:
        """Raise InvalidInput for a value that is not allowed."""
        for option in OPTIONS.values():
            option.check(attrgetter(option.name)(self))
        OPTIONS["seed"].check(self.seed + self.repeat - 1)


OPTIONS = {option.name: option for option in options_of(Submission)}
"""The fields of a :class:`Submission` by dotted name, those of its stop rules included."""


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a :class:`Submission` from values by dotted name."""
    rules = {name.removeprefix(_RULE_PREFIX): value for name, value in values.items() if name.startswith(_RULE_PREFIX)}
    fields = {name: value for name, value in values.items() if not name.startswith(_RULE_PREFIX)}
    return {**fields, "stop_when": StopWhen(**rules)} if rules else fields


def parse_stop_when(texts: Sequence[str]) -> StopWhen:
    """The rules written as ``RULE=NUMBER``; raises NotFound or InvalidInput naming the text."""
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, number = text.partition("=")
        if not equals:
            raise InvalidInput(f"stop rule {text!r} is not clear", f"write RULE=NUMBER, e.g. {RULES[0]}=5")
        if name not in RULES:
            raise unknown("stop rule", name, list(RULES), f"use one of {', '.join(RULES)}")
        if name in values:
            raise InvalidInput(f"stop rule {name} is given twice", "give it once")
        option = OPTIONS[_RULE_PREFIX + name]
        try:
            values[name] = option.kind(number)
        except ValueError:
            raise InvalidInput(f"stop rule {name}={number!r} is not allowed", f"use {option.expectation}") from None
        option.check(values[name])
    return StopWhen(**values)
