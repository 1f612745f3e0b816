"""All checks, in the order in which their findings are listed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from slamhive.checks import (
    camera_motion,
    depths,
    images,
    inertial,
    inertial_truth,
    stereo,
    streams,
    sweep_motion,
    sweeps,
    timestamps,
    truth,
)
from slamhive.checks.evidence import Evidence, Findings


@dataclass(frozen=True, slots=True)
class Check:
    """A function that judges evidence, and the names of what it checks."""

    names: tuple[str, ...]
    run: Callable[[Evidence], Findings]


CHECKS = (
    Check(("topics",), streams.topics),
    Check(("spans",), streams.spans),
    Check(("rates",), streams.rates),
    Check(("order",), timestamps.order),
    Check(("duplicates",), timestamps.duplicates),
    Check(("gaps",), timestamps.gaps),
    Check(("clock-jumps",), timestamps.clock_jumps),
    Check(("clocks",), timestamps.clocks),
    Check(truth.CHECKS, truth.ground_truth),
    Check(("gravity",), inertial.gravity),
    Check(("imu-rates",), inertial.angular_rates),
    Check(inertial_truth.CHECKS, inertial_truth.imu_and_truth),
    Check(("image-size", "image-encoding"), images.image_size),
    Check(("intrinsics",), images.intrinsics),
    Check(("image-dark", "image-saturated"), images.exposure),
    Check(("image-blur",), images.sharpness),
    Check(("image-frozen",), images.frozen),
    Check(("stereo-partners", "stereo-sync"), stereo.synchronisation),
    Check(("stereo-geometry",), stereo.epipolar),
    Check(("camera-motion", "stereo-scale", "truth-scale"), camera_motion.camera_and_truth),
    Check(("depth-values", "depth-scale"), depths.depth_values),
    Check(("lidar-empty",), sweeps.empty_sweeps),
    Check(("lidar-ranges",), sweeps.ranges),
    Check(("lidar-point-times",), sweeps.point_times),
    Check(("lidar-direction",), sweeps.direction),
    Check(("lidar-stamp",), sweeps.meaning_of_timestamp),
    Check(("lidar-motion",), sweep_motion.lidar_and_truth),
)

EXPLAINS: dict[str, tuple[str, ...]] = {
    "clock-jumps": ("clocks", "spans"),
    "image-size": ("intrinsics",),
    "imu-rates": ("imu-axes",),
    "imu-units": ("imu-rates",),
    "stereo-geometry": ("depth-scale", "stereo-scale", "truth-scale"),
    "truth-scale": ("lidar-motion",),
    "truth-orientation": ("camera-motion", "gravity-direction", "imu-axes", "lidar-motion"),
}
"""Findings that follow from another one. They are listed as not checked, so that the cause stands out."""

NAMES = tuple(dict.fromkeys(name for check in CHECKS for name in check.names))
