"""The options of a run: its limits, and when it ends early. Every command that reads runs imports this."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from functools import cache
from operator import attrgetter
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args, get_origin, get_type_hints

from slamhive.base.errors import InvalidInput
from slamhive.domain.names import plain

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler


_SHOWN = 40


@dataclass(frozen=True, slots=True)
class Asked:
    """Meaning and allowed values of an option, for ``Annotated``.

    ``help`` is one sentence for users. ``title`` is the label, None for the name of the field. ``unit`` is that of the
    number, empty for none. Options of one ``group`` stand together in web forms. A number is at least ``ge``, more than
    ``gt`` and at most ``le``.
    """

    help: str
    title: str | None = None
    unit: str = ""
    group: str = ""
    ge: float | None = None
    gt: float | None = None
    le: float | None = None

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> Any:
        """Constraints for pydantic and the JSON Schema."""
        from slamhive.documents.model import described  # noqa: PLC0415 - loads pydantic

        rules = {key: limit for key in ("ge", "gt", "le") if (limit := getattr(self, key)) is not None}
        field = described(self.help, title=self.title, unit=self.unit, group=self.group, **rules)
        return handler.generate_schema(Annotated[kind, field])


@dataclass(frozen=True, slots=True)
class Option:
    """One field that a user can set.

    ``name`` is dotted for a field of a nested model (``stop_when.time_s``). ``kind`` is the type of a value, without
    None. ``above`` says that ``minimum`` itself is not allowed.
    """

    name: str
    kind: Any
    default: Any
    title: str
    help: str
    unit: str
    group: str
    minimum: float | None = None
    maximum: float | None = None
    above: bool = False

    @property
    def label(self) -> str:
        """The title with the unit, as messages use it: ``memory limit in MB``."""
        if "." in self.name:
            return self.name.replace(".", " ")
        title = self.title[:1].lower() + self.title[1:] if self.title[1:2].islower() else self.title
        return f"{title} in {self.unit}" if self.unit else title

    @property
    def heading(self) -> str:
        """The title with the unit, as forms and tables show it: ``Memory limit [MB]``."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    @property
    def choices(self) -> tuple[str, ...]:
        """The values of an enumeration; empty for other kinds."""
        return tuple(self.kind) if isinstance(self.kind, type) and issubclass(self.kind, StrEnum) else ()

    @property
    def is_number(self) -> bool:
        """True if values are numbers."""
        return self.kind in (int, float)

    @property
    def expectation(self) -> str:
        """Describe the allowed values: ``1 to 1000``, ``a whole number above 0``."""
        number = "a whole number" if self.kind is int else "a number"
        if self.maximum is not None and self.minimum is not None:
            return f"{plain(self.minimum)} to {plain(self.maximum)}"
        if self.minimum is not None:
            return f"{number} {'above' if self.above else 'from'} {plain(self.minimum)}"
        return number if self.is_number else f"one of {', '.join(self.choices)}" if self.choices else ""

    def read(self, text: str) -> Any:
        """The value that was typed; empty text stands for the default. Raises InvalidInput."""
        text = text.strip()
        if not text:
            return self.default
        if self.kind is bool:
            return text == "yes"
        if self.is_number:
            try:
                value = self.kind(text)
            except ValueError:
                what = "a whole number" if self.kind is int else "a number"
                raise InvalidInput(f"{text[:_SHOWN]!r} is not {what}", f"use {self.expectation}") from None
            self.check(value)
            return value
        self.check(text)
        return self.kind(text) if self.choices else text

    def check(self, value: Any) -> None:
        """Raise InvalidInput for a value that is not allowed."""
        if value is None:
            return
        if self.choices and value not in self.choices:
            raise InvalidInput(f"{self.label} {str(value)[:_SHOWN]!r} is not known", f"use {self.expectation}")
        if self.is_number and not self.allows(value):
            shown = f"{value:.10g}" if isinstance(value, float) else value
            raise InvalidInput(f"{self.label} {shown} is not allowed", f"use {self.expectation}")

    def allows(self, value: float) -> bool:
        """Tell if a number is in the range of the option."""
        low = self.minimum is None or value > self.minimum or (value == self.minimum and not self.above)
        return low and math.isfinite(value) and (self.maximum is None or value <= self.maximum)


@cache
def options_of(model: type[Any], prefix: str = "") -> tuple[Option, ...]:
    """The described fields of a dataclass, those of nested ones included: its own in order, then inherited ones."""
    hints = get_type_hints(model, include_extras=True)
    found: list[Option] = []
    for field in sorted(dataclasses.fields(model), key=lambda field: field.name not in model.__annotations__):
        kind, info = _parts(hints[field.name])
        if dataclasses.is_dataclass(kind):
            found += options_of(kind, f"{prefix}{field.name}.")  # type: ignore[arg-type]
        elif info is not None:
            found.append(_option(prefix + field.name, kind, field, info))
    return tuple(found)


def _option(name: str, kind: Any, field: dataclasses.Field[Any], info: Asked) -> Option:
    return Option(
        name=name,
        kind=kind,
        default=None if field.default is dataclasses.MISSING else field.default,
        title=info.title or name.replace("_", " ").capitalize(),
        help=info.help,
        unit=info.unit,
        group=info.group,
        minimum=info.gt if info.ge is None else info.ge,
        maximum=info.le,
        above=info.gt is not None,
    )


def _parts(annotation: Any) -> tuple[Any, Asked | None]:
    """The type without None, and how the field is described."""
    info = None
    if get_origin(annotation) is Annotated:
        annotation, *extras = get_args(annotation)
        info = next((entry for entry in extras if isinstance(entry, Asked)), None)
    if get_origin(annotation) in (Union, UnionType):
        (annotation, *_) = (part for part in get_args(annotation) if part is not type(None))
    return annotation, info


# The options of a run: its limits, and when it ends early. Every command that reads runs imports this.


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


SlowDown = Annotated[
    float,
    Asked(
        "Slow each run down by this factor: of each core that it has, it gets 1 / factor of the time.",
        title="Slowed down",
        unit="times",
        group="limits",
        ge=1,
        le=20,
    ),
]
NO_SLOW_DOWN = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of each run; None means the default of the settings or of the package."""

    cpu_cores: CpuCores = None
    memory_mb: MemoryMb = None
    timeout_s: TimeoutS = None
    nice: Nice = 0
    slow_down: SlowDown = NO_SLOW_DOWN

    def varied(self, values: Mapping[str, Any]) -> Limits:
        """The limits alone, with other values by name."""
        return dataclasses.replace(self.limits, **values)

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
