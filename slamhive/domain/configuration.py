"""A configuration: what exactly is run. Two configurations with equal content are one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol

from slamhive.base.errors import InvalidInput
from slamhive.domain.packages import version_label
from slamhive.domain.parameters import Scalar, Value
from slamhive.domain.roles import Chosen
from slamhive.domain.sensors import Sensor

# A variant of a dataset: the pre-processing steps that its recording went through, in order.


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


def variant_of(stored: Iterable[Mapping[str, Any]] | None) -> Variant:
    """The variant from the fields of its steps, as the database holds them; None is the dataset itself."""
    return tuple(VariantStep(**step) for step in stored or ())


CLIP = "clip"
"""The step that keeps a part of a recording, between its options ``begin_s`` and ``end_s``."""


def clipped_span_s(sensors: Iterable[str], variant: Variant) -> tuple[float, float] | None:
    """The times (s) between which a variant has messages; None unless each of the sensors is clipped."""
    spans: list[tuple[float, float]] = []
    for name in sensors:
        clips = [step.options for step in variant if step.kind == CLIP and name in step.sensors]
        if not clips:
            return None
        spans.append((max(float(clip["begin_s"]) for clip in clips), min(float(clip["end_s"]) for clip in clips)))
    return (min(begin_s for begin_s, _ in spans), max(end_s for _, end_s in spans)) if spans else None


class StepRules(Protocol):
    """Knowledge about the kinds of steps, implemented by the maker of variants."""

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


_as_json = json.JSONEncoder(sort_keys=True, separators=(",", ":"), allow_nan=False).encode


class PlaybackMode(StrEnum):
    """Feeding of the recording: in real time (a slow algorithm loses frames) or one message after the other."""

    REALTIME = "realtime"
    SEQUENTIAL = "sequential"


@dataclass(frozen=True, slots=True)
class Playback:
    """Playback of the recording; ``rate`` scales real time (2.0 is twice as fast)."""

    mode: PlaybackMode = PlaybackMode.REALTIME
    rate: float = 1.0


@dataclass(frozen=True, slots=True)
class InputMap:
    """The map that a run starts with: the uid of the run that saved it, and the hash of the map, ``sha256:<hex>``."""

    run: str
    content: str


@dataclass(frozen=True, slots=True)
class Configuration:
    """An algorithm, a dataset and what is done to it beforehand, the values of parameters, and how the data is fed.

    ``parameters`` lacks those that are taken from sensors. ``sensors`` is what the user chose in place of the rule, in
    the form of :meth:`~slamhive.domain.algorithm.Algorithm.stated_choice`. ``version`` is the version of the package
    that was asked for, None for the newest at the time of the run. ``map`` is the map that the algorithm starts with.
    """

    algorithm: str
    dataset: str
    parameters: dict[str, Value]
    playback: Playback = Playback()
    variant: Variant = ()
    sensors: Chosen = field(default_factory=dict)
    version: int | None = None
    map: InputMap | None = None

    @property
    def algorithm_label(self) -> str:
        """The algorithm as it is asked for: ``aloam``, or ``aloam@2`` for a version."""
        return self.algorithm if self.version is None else version_label(self.algorithm, self.version)

    @property
    def content_hash(self) -> str:
        """SHA-256 over the content, independent of the order in which parameters were given."""
        parameters = ",".join(parameter_content(key, self.parameters[key]) for key in sorted(self.parameters))
        return content_hash(self.content_around_parameters, parameters)

    @property
    def content_around_parameters(self) -> tuple[str, str]:
        """The content as JSON with sorted keys, before the list of parameters and after it."""
        before: dict[str, object] = {"algorithm": self.algorithm, "dataset": self.dataset}
        if self.map is not None:
            before["map"] = self.map.content
        after: dict[str, object] = {"playback": [self.playback.mode.value, float(self.playback.rate)]}
        if self.sensors:
            after["sensors"] = dict(self.sensors)
        if self.variant:
            after["variant"] = [step.content for step in self.variant]
        if self.version is not None:
            after["version"] = self.version
        return f'{_as_json(before)[:-1]},"parameters":{{', f"}},{_as_json(after)[1:]}"


def content_hash(around: tuple[str, str], parameters: str) -> str:
    """The hash of a configuration, from its content around the parameters, and these in the order of their keys."""
    return hashlib.sha256(parameters.join(around).encode()).hexdigest()


def parameter_content(key: str, value: Value) -> str:
    """A parameter in the content: with the type of its value, so that 1, 1.0, True and "1" stay four values."""
    tagged = [type(value).__name__, list(value) if isinstance(value, tuple) else value]
    return f"{_as_json(key)}:{_as_json(tagged)}"
