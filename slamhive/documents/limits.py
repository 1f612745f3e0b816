"""The options of a run: its limits, and when it ends early. Every command that reads runs imports this."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Annotated, Any

from slamhive.documents.options import Asked, options_of

CpuCores = Annotated[
    float | None,
    Asked(
        "CPU limit of each run; by default that of the settings.",
        title="CPU limit",
        unit="cores",
        group="limits",
        ge=0.1,
        le=1024,
    ),
]
MemoryMb = Annotated[
    int | None,
    Asked(
        "Memory limit of each run; by default what the algorithm asks for.",
        title="Memory limit",
        unit="MB",
        group="limits",
        ge=16,
        le=10_000_000,
    ),
]
TimeoutS = Annotated[
    float | None,
    Asked(
        "Wall-clock limit of each run; by default derived from the duration of the recording.",
        title="Time limit",
        unit="s",
        group="limits",
        ge=1,
        le=30 * 86_400,
    ),
]
Nice = Annotated[
    int,
    Asked(
        "Niceness of the processes of each run; higher lets other processes go first.",
        title="Niceness",
        group="limits",
        ge=0,
        le=19,
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of each run; None means the default of the settings or of the package."""

    cpu_cores: CpuCores = None
    memory_mb: MemoryMb = None
    timeout_s: TimeoutS = None
    nice: Nice = 0

    @property
    def limits(self) -> Limits:
        """The limits alone."""
        return Limits(**{field.name: getattr(self, field.name) for field in fields(Limits)})


def _rule(title: str, description: str, unit: str = "") -> Any:
    return Asked(description, title=title, unit=unit, group="stop_when", gt=0)


@dataclass(frozen=True, slots=True)
class StopWhen:
    """Rule that ends a run early, with the reason recorded. None never ends one."""

    lost_tracking_s: Annotated[
        float | None, _rule("No pose for", "End the run after so many seconds of the recording without a pose.", "s")
    ] = None
    memory_mb: Annotated[int | None, _rule("Memory above", "End the run when it uses more memory.", "MB")] = None
    time_s: Annotated[float | None, _rule("Time above", "End the run when it takes longer.", "s")] = None
    failures_of_configuration: Annotated[
        int | None,
        _rule("Failures of its configuration", "Skip the run once its configuration has failed this often."),
    ] = None

    @property
    def content(self) -> dict[str, Any]:
        """The rules that are set, as JSON."""
        return {name: value for name in RULES if (value := getattr(self, name)) is not None}

    @classmethod
    def of(cls, content: Mapping[str, Any] | None) -> StopWhen:
        """The rules of :attr:`content`. None, for an absent column or key, is no rule; unknown rules are ignored."""
        return cls(**{name: value for name, value in (content or {}).items() if name in RULES})


RULES = tuple(field.name for field in fields(StopWhen))
NEVER = StopWhen()
"""No rule: the run ends by itself or at its limits."""

Priority = Annotated[int, Asked("Runs with a higher priority start first.", ge=-1000, le=1000)]
RepeatDisturbed = Annotated[
    int,
    Asked(
        "How often a run is repeated at most because the machine was disturbed while it was measured.",
        title="Repeat if disturbed",
        ge=0,
        le=10,
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions(Limits):
    """The options of a run besides its configuration, its seed and its executor.

    What asks for runs and what stores them inherit these fields, or take them over by :attr:`options`, so that an
    option is added here and where it takes effect. JSON stays flat.
    """

    priority: Priority = 0
    evaluate: Annotated[bool, Asked("Evaluate each run that succeeds.")] = True
    stop_when: Annotated[StopWhen, Asked("Rules that end a run early.")] = NEVER
    repeat_disturbed: RepeatDisturbed = 0

    @property
    def options(self) -> dict[str, Any]:
        """The options by name, as keyword arguments."""
        return options_in(self)

    @property
    def stated(self) -> dict[str, Any]:
        """The options that are not at their defaults, by heading: what pages and commands show."""
        values = ((option, attrgetter(option.name)(self)) for option in options_of(RunOptions))
        return {
            option.heading: ("yes" if value else "no") if isinstance(value, bool) else value
            for option, value in values
            if value != option.default
        }


OPTION_NAMES = tuple(field.name for field in fields(RunOptions))


def options_in(source: object) -> dict[str, Any]:
    """The options of a run in any object with these attributes, such as a document."""
    return {name: getattr(source, name) for name in OPTION_NAMES}
