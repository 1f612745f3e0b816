"""Depth images by themselves: valid pixels and plausible distances."""

from __future__ import annotations

import numpy as np

from slamhive.checks.evidence import Evidence, Findings, Stream
from slamhive.checks.geometry import calibrated
from slamhive.domain.checks import NotChecked, Severity
from slamhive.domain.sensors import SensorKind

LIKELY_M = (0.2, 60.0)
"""Median depth of a recording: depth cameras see 0.2 to 10 m, rendered outdoor scenes more."""
LEAST_VALID = 0.1


def typical_depth_m(stream: Stream) -> float | None:
    """Median over the sampled images of the median depth, None without valid pixels."""
    if stream.depths is None or not np.isfinite(stream.depths.median_raw).any():
        return None
    return float(np.nanmedian(stream.depths.median_raw)) / calibrated(stream.sensor, "units_per_m")


def depth_values(evidence: Evidence) -> Findings:
    """Depth images have values, and these are distances in the range of a depth camera."""
    for stream in evidence.of_kind(SensorKind.DEPTH):
        if stream.depths is None or len(stream.depths.valid_share) == 0:
            yield NotChecked("depth-values", stream.sensor.name, "no depth image can be read")
            continue
        empty = float(np.mean(stream.depths.valid_share < LEAST_VALID))
        if empty > 0.5:
            yield stream.finding(
                "depth-values",
                Severity.WARNING,
                f"{empty:.0%} of the depth images of {stream.sensor.name} have hardly any valid pixel.",
                "check the conversion: 0 means no value",
                value=round(100 * float(np.median(stream.depths.valid_share)), 1),
                unit="% valid",
                expected=f"at least {LEAST_VALID:.0%}",
            )
        typical_m = typical_depth_m(stream)
        if typical_m is not None and not LIKELY_M[0] <= typical_m <= LIKELY_M[1]:
            yield stream.finding(
                "depth-scale",
                Severity.ERROR,
                f"{stream.sensor.name} sees {typical_m:.3g} m as the median depth.",
                "correct units_per_m in dataset.yaml (1000 for mm, 5000 for TUM RGB-D, 1 for 32FC1)",
                value=typical_m,
                unit="m",
                expected=f"{LIKELY_M[0]} m to {LIKELY_M[1]:g} m",
            )
