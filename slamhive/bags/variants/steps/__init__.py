"""All pre-processing steps by name, one file each; plug-ins find their way in by entry point."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from slamhive.bags.variants.step import Step
from slamhive.bags.variants.steps.calibration import Calibration
from slamhive.bags.variants.steps.defocus_blur import DefocusBlur
from slamhive.bags.variants.steps.depth_range import DepthRange
from slamhive.bags.variants.steps.drop_bursts import DropBursts
from slamhive.bags.variants.steps.drop_out import DropOut
from slamhive.bags.variants.steps.exposure import Exposure
from slamhive.bags.variants.steps.fog import Fog
from slamhive.bags.variants.steps.gamma import Gamma
from slamhive.bags.variants.steps.gaussian_noise import GaussianNoise
from slamhive.bags.variants.steps.imu_bias import ImuBias
from slamhive.bags.variants.steps.imu_noise import ImuNoise
from slamhive.bags.variants.steps.imu_saturation import ImuSaturation
from slamhive.bags.variants.steps.motion_blur import MotionBlur
from slamhive.bags.variants.steps.point_beams import PointBeams
from slamhive.bags.variants.steps.point_range import PointRange
from slamhive.bags.variants.steps.point_stride import PointStride
from slamhive.bags.variants.steps.range_noise import RangeNoise
from slamhive.bags.variants.steps.rate import Rate
from slamhive.bags.variants.steps.resolution import Resolution
from slamhive.bags.variants.steps.shot_noise import ShotNoise
from slamhive.bags.variants.steps.stamp_jitter import StampJitter
from slamhive.bags.variants.steps.time_offset import TimeOffset
from slamhive.bags.variants.steps.voxel import Voxel
from slamhive.errors import InvalidInput
from slamhive.registry import Registry, subclasses_of
from slamhive.schema.validation import first_problem

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
    ImuNoise,
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
