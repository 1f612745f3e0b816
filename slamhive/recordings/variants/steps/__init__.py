"""All pre-processing steps by name, one file each; plug-ins find their way in by entry point."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from slamhive.base.errors import InvalidInput
from slamhive.base.registry import Registry, subclasses_of
from slamhive.documents.validation import first_problem
from slamhive.recordings.variants.step import Step
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
from slamhive.recordings.variants.steps.timing import DropBursts, DropOut, Rate, StampJitter, TimeOffset

STEPS: Registry[type[Step]] = Registry("pre-processing step", "slamhive.variant_steps", subclasses_of(Step, "kind"))
_SHIPPED: tuple[type[Step], ...] = (
    Rate,
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
