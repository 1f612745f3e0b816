"""Whether a run was measured on a disturbed machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

from slamhive.domain.disturbance import Disturbance, DisturbanceLimits, judge
from slamhive.runs.folder import RunFolder
from slamhive.runs.host_load import read_host_load
from slamhive.settings import Settings


def judge_run(folder: RunFolder, metrics: Mapping[str, float], settings: Settings) -> Disturbance:
    """Judge the run in ``folder`` by the limits of the installation."""
    limits = DisturbanceLimits(
        **{entry.name: getattr(settings, f"disturbed_{entry.name}") for entry in fields(DisturbanceLimits)}
    )
    lag_s = metrics.get("playback.lag_max")
    return judge(read_host_load(folder.host), metrics["duration"], lag_s, limits)
