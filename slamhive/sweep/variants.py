"""Steps on sensors, in the canonical order and spelling that identifies a variant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import Scalar
from slamhive.domain.sensors import Sensor
from slamhive.domain.variant import StepRules, Variant, VariantStep


def resolve_variant(rules: StepRules, dataset: Dataset, steps: Iterable[VariantStep]) -> Variant:
    """``steps`` on ``dataset`` with canonical options, those left out that change nothing.

    Raises NotFound or InvalidInput for a sensor, step or option that does not exist or makes no sense.
    """
    sensors = {sensor.name: sensor for sensor in dataset.sensors}
    variant: list[VariantStep] = []
    for step in steps:
        names = [dataset.sensor(name).name for name in step.sensors]
        variant.extend(resolve_step(rules, step.kind, step.options, names, sensors))
    return tuple(variant)


def seen_dataset(rules: StepRules, dataset: Dataset, variant: Variant) -> Dataset:
    """``dataset`` with its sensors as ``variant`` leaves them; raises as :func:`resolve_variant`."""
    sensors = {sensor.name: sensor for sensor in dataset.sensors}
    for step in variant:
        names = [dataset.sensor(name).name for name in step.sensors]
        resolve_step(rules, step.kind, step.options, names, sensors)
    return replace(dataset, sensors=tuple(sensors.values()))


def resolve_step(
    rules: StepRules,
    kind: str,
    options: Mapping[str, Scalar],
    names: Sequence[str],
    sensors: dict[str, Sensor],
) -> list[VariantStep]:
    """One step on the sensors called ``names``; sensors that it treats alike share a step.

    ``sensors`` holds every sensor as the steps before have left it, and is brought up to date.
    """
    merged: dict[VariantStep, list[str]] = {}
    for name in names:
        resolved, sensors[name] = rules.resolve(kind, options, sensors[name])
        if resolved is not None:
            merged.setdefault(VariantStep(resolved.kind, (), resolved.options), []).append(name)
    return [VariantStep(step.kind, tuple(treated), step.options) for step, treated in merged.items()]
