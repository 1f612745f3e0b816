"""All pre-processing steps by name, and facts about them; plug-ins find their way in by entry point."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from slamhive.base.errors import InvalidInput
from slamhive.base.registry import Registry, subclasses_of
from slamhive.documents.catalogue import StepOptionDocument
from slamhive.documents.model import first_problem
from slamhive.domain.configuration import VariantStep
from slamhive.domain.dataset import Dataset
from slamhive.domain.names import plain
from slamhive.domain.parameters import Scalar
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.variants.step import SeededStep, Step
from slamhive.recordings.variants.steps.camera import (
    Calibration,
    DefocusBlur,
    DepthRange,
    Exposure,
    Gamma,
    GaussianNoise,
    MotionBlur,
    Resolution,
    ShotNoise,
)
from slamhive.recordings.variants.steps.imu import AddedImuNoise, ImuBias, ImuSaturation
from slamhive.recordings.variants.steps.lidar import Fog, PointBeams, PointRange, PointStride, RangeNoise, Voxel
from slamhive.recordings.variants.steps.timing import Clip, DropBursts, DropOut, Rate, StampJitter, TimeOffset

STEPS: Registry[type[Step]] = Registry("pre-processing step", "slamhive.variant_steps", subclasses_of(Step, "kind"))
_SHIPPED: tuple[type[Step], ...] = (
    Rate,
    Clip,
    Resolution,
    Calibration,
    DepthRange,
    PointBeams,
    PointRange,
    PointStride,
    Voxel,
    DefocusBlur,
    DropBursts,
    DropOut,
    Exposure,
    Fog,
    Gamma,
    GaussianNoise,
    ImuBias,
    AddedImuNoise,
    ImuSaturation,
    MotionBlur,
    RangeNoise,
    ShotNoise,
    StampJitter,
    TimeOffset,
)
for step_type in _SHIPPED:
    STEPS.register(step_type.kind, step_type)


def make_step(kind: str, options: Mapping[str, Any]) -> Step:
    """The step called ``kind`` with ``options``; raises NotFound or InvalidInput that names the option."""
    step_type = STEPS.get(kind)
    try:
        return step_type.model_validate(dict(options))
    except ValidationError as error:
        known = ", ".join(step_type.model_fields)
        raise InvalidInput(f"step {kind}: {first_problem(error)}", f"options: {known}") from None


# Facts about the kinds of steps without any recording: for forms, experiments and documentation.


_BOUNDS = {
    "minimum": "at least {}",
    "exclusiveMinimum": "above {}",
    "maximum": "at most {}",
    "exclusiveMaximum": "below {}",
}


class RegisteredSteps:
    """The rules of all registered steps, as :class:`slamhive.domain.configuration.StepRules` asks for them."""

    def kinds(self) -> Sequence[str]:
        """The names of all steps."""
        return STEPS.names()

    def options(self, kind: str) -> Sequence[str]:
        """The names of the options of ``kind``; raises NotFound."""
        return list(STEPS.get(kind).model_fields)

    def resolve(self, kind: str, options: Mapping[str, Scalar], sensor: Sensor) -> tuple[VariantStep | None, Sensor]:
        """The step on one sensor with every option, and the sensor afterwards; None where nothing changes.

        Raises NotFound for an unknown kind, InvalidInput for options or a sensor that the step cannot use.
        """
        step = make_step(kind, options)
        if not step.applies_to(sensor):
            raise InvalidInput(
                f"step {kind} cannot be used on {sensor.name} ({sensor.topic}), a sensor of kind {sensor.kind.value}"
            )
        step.check(sensor)
        if step.is_identity(sensor):
            return None, sensor
        return VariantStep(kind, (sensor.name,), step.model_dump(exclude_none=True)), step.calibrate(sensor)


def on_all_sensors(dataset: Dataset, step: VariantStep) -> VariantStep:
    """``step``, or if it names no sensors, the same for all that it can treat.

    Raises NotFound or InvalidInput for an unknown step or option, and if there is no such sensor.
    """
    if step.sensors:
        return step
    made = make_step(step.kind, step.options)
    names = tuple(sensor.name for sensor in dataset.sensors if made.applies_to(sensor))
    if not names:
        raise InvalidInput(f"step {step.kind}: dataset {dataset.name} has no sensor for it")
    return VariantStep(step.kind, names, step.options)


def describe_step(kind: str) -> str:
    """First sentence of a step's description, in one line; raises NotFound."""
    return explain_step(kind).partition("\n")[0].replace("`", "")


def explain_step(kind: str) -> str:
    """Description of a step as Markdown; raises NotFound."""
    return inspect.cleandoc(STEPS.get(kind).__doc__ or "").replace("``", "`")


def treated_kinds(kind: str) -> tuple[SensorKind, ...]:
    """The kinds of sensors that a step can be used on; raises NotFound."""
    step = STEPS.get(kind).model_construct()
    return tuple(entry for entry in SensorKind if step.applies_to(Sensor("", entry, "", 1.0)))


def describe_options(kind: str) -> tuple[StepOptionDocument, ...]:
    """Every option of a step with type, unit, range and meaning, the seed last; raises NotFound."""
    step_type = STEPS.get(kind)
    schema = step_type.model_json_schema()
    required = schema.get("required", [])
    entries = sorted(schema["properties"].items(), key=lambda entry: entry[0] in SeededStep.model_fields)
    return tuple(_option(name, entry, required=name in required) for name, entry in entries)


def _option(name: str, entry: Mapping[str, Any], *, required: bool) -> StepOptionDocument:
    kinds = [part for part in entry.get("anyOf", [entry]) if part.get("type") != "null"]
    value = kinds[0]
    choices = value.get("enum")
    bounds = [words.format(_number(value[key])) for key, words in _BOUNDS.items() if key in value]
    return StepOptionDocument(
        name=name,
        type=str(value.get("type", "string")),
        default=entry.get("default"),
        required=required,
        unit=str(entry.get("unit", "")),
        allowed=" or ".join(choices) if choices else ", ".join(bounds),
        help=str(entry.get("description", "")),
        choices=("true", "false") if value.get("type") == "boolean" else tuple(choices or ()),
    )


def _number(value: float) -> str:
    return f"{value:g}" if abs(value) < 1_000_000 else str(value)
