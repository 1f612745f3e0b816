"""A variant of a dataset: the pre-processing steps that its recording went through, in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from slamhive.domain.parameters import Scalar
from slamhive.domain.sensors import Sensor
from slamhive.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class VariantStep:
    """One pre-processing step on some sensors of a dataset.

    ``kind`` is the registered name of the step (``rate``, ``resolution``, ``noise_gaussian`` ...). ``sensors`` are
    names of the dataset's sensors (a sorted set), ``options`` the settings with the types of the step. Equal steps have
    equal content, and are hashable.
    """

    kind: str
    sensors: tuple[str, ...] = ()
    options: Mapping[str, Scalar] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensors", tuple(sorted(set(self.sensors))))
        object.__setattr__(self, "options", dict(sorted(self.options.items())))

    def __hash__(self) -> int:
        return hash((self.kind, self.sensors, tuple(self.options.items())))

    @property
    def content(self) -> list[object]:
        """The step as plain JSON, with the type of each option, so that 1, 1.0 and True stay different."""
        options = {key: [type(value).__name__, value] for key, value in self.options.items()}
        return [self.kind, list(self.sensors), options]

    @property
    def brief(self) -> str:
        """The kind and the options, numbers before words; for tables, where it may be cut off at its end."""
        numbers_first = sorted(self.options.items(), key=lambda option: isinstance(option[1], str))
        return " ".join([self.kind, *(f"{key}={_text(value)}" for key, value in numbers_first)])

    def __str__(self) -> str:
        options = ", ".join(f"{key} {_text(value)}" for key, value in self.options.items())
        return f"{self.kind} of {', '.join(self.sensors)}" + (f" ({options})" if options else "")


def _text(value: Scalar) -> str:
    return format(value, ".12g") if isinstance(value, float) else str(value)


_STEP_FORM = "write it as KIND@SENSOR,SENSOR OPTION=VALUE, for instance: resolution@cam0,cam1 scale=0.5"

Variant = tuple[VariantStep, ...]
"""Steps in the order in which they are applied; the order is part of the identity. Empty: the dataset itself."""


class StepRules(Protocol):
    """What is known of the kinds of steps; whoever makes variants implements it."""

    def kinds(self) -> Sequence[str]:
        """The names of all steps."""

    def options(self, kind: str) -> Sequence[str]:
        """The names of the options of ``kind``; raises NotFound."""

    def resolve(self, kind: str, options: Mapping[str, Scalar], sensor: Sensor) -> tuple[VariantStep | None, Sensor]:
        """The step on one sensor with canonical options, and the sensor as the step leaves it.

        The step is None where it changes nothing (every factor is 1). Raises NotFound for an unknown kind and
        InvalidInput for options that make no sense, on this sensor or at all.
        """


def parse_step(text: str) -> VariantStep:
    """``KIND[@SENSOR,...] [OPTION=VALUE ...]``, as typed on a command line, to a step whose options are still text.

    Without sensors it is meant for all that the step can treat. Raises InvalidInput.
    """
    head, *settings = text.split() if text.strip() else [""]
    kind, _, sensors = head.partition("@")
    options: dict[str, Scalar] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not key or not equals or key in options:
            raise InvalidInput(f"step {text!r}: {setting!r} is no new OPTION=VALUE", _STEP_FORM)
        options[key] = value
    if not kind:
        raise InvalidInput(f"step {text!r} names no kind", _STEP_FORM)
    return VariantStep(kind, tuple(name for name in sensors.split(",") if name), options)


def step_text(step: VariantStep) -> str:
    """The text that :func:`parse_step` reads back to an equal step once its options are resolved."""
    options = [
        f"{key}={str(value).lower() if isinstance(value, bool) else value}" for key, value in step.options.items()
    ]
    return " ".join([f"{step.kind}@{','.join(step.sensors)}" if step.sensors else step.kind, *options])
