"""The metric catalogue: each metric that a run can have is defined here, once, and nowhere else."""

from __future__ import annotations

from slamhive.domain.metrics.maps import MAP_METRICS
from slamhive.domain.metrics.measured import MEASURED_METRICS
from slamhive.domain.metrics.model import Direction, Group, Metric
from slamhive.domain.metrics.references import REFERENCE_METRICS
from slamhive.domain.metrics.trajectories import TRAJECTORY_METRICS
from slamhive.errors import unknown

__all__ = ["CATALOGUE", "Direction", "Group", "Metric", "metric"]

CATALOGUE: dict[str, Metric] = {
    entry.key: entry for entry in (*TRAJECTORY_METRICS, *REFERENCE_METRICS, *MAP_METRICS, *MEASURED_METRICS)
}


def metric(key: str) -> Metric:
    """The metric called ``key``; raises NotFound with the nearest name."""
    try:
        return CATALOGUE[key]
    except KeyError:
        raise unknown("metric", key, list(CATALOGUE)) from None
