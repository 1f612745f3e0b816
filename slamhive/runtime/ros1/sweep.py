"""How the points of a LiDAR state ring and time, for ROS nodes: the parameters that ``slamhive/sweep.h`` reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from slamhive.runtime.point_times import PointTimes, TimeReference

NAMESPACE = "/slamhive/sweep"


def sweep_times(values: Mapping[str, Any], role: str = "points") -> PointTimes:
    """When the points of the LiDAR in ``role`` were measured, from the parameters of a run."""
    return PointTimes.of(values, float(values[f"{role}_rate_hz"]), role, f"{role}_")


def sweep_parameters(values: Mapping[str, Any], *, rotation: str = "clockwise", role: str = "points") -> dict[str, Any]:
    """The parameters of the LiDAR in ``role``.

    ``rotation`` is the direction in which it turns, seen from above: ``clockwise`` or ``counter-clockwise``. Nodes use
    it for points without a time.
    """
    times = sweep_times(values, role)
    since_start_s = times.stamp.fraction * times.scan_duration_s
    return {
        NAMESPACE: {
            "ring_field": str(values.get(f"{role}_ring_field", "")),
            "time_field": times.field,
            "time_unit_s": times.unit.seconds,
            "time_zero_s": since_start_s if times.reference is TimeReference.TIMESTAMP else 0.0,
            "absolute": times.reference is TimeReference.ABSOLUTE,
            "duration_s": times.scan_duration_s,
            "stamp_fraction": times.stamp.fraction,
            "clockwise": rotation == "clockwise",
        }
    }


def middle_delay_s(values: Mapping[str, Any], role: str = "points") -> float:
    """How long after the timestamp of its message the middle of a sweep is, in s."""
    times = sweep_times(values, role)
    return times.start_s(0.0) + 0.5 * times.scan_duration_s
