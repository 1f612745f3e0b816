"""Reads ``host.csv``, the counters of the machine during a run.

The counters only grow, so a gap between two lines, as when the worker restarts, costs nothing but resolution.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from slamhive.domain.disturbance import HostInterval, HostLoad
from slamhive.runs.host_columns import COLUMNS, NOT_MEASURED
from slamhive.runs.untrusted import FloatArray, read_numeric_columns, read_untrusted_lines

_MAX_BYTES = 200_000_000
_PRESSURES = ("cpu_pressure", "io_pressure", "memory_pressure")


def read_host_load(path: Path) -> HostLoad:
    """Read ``host.csv``; nothing is measured where it is missing."""
    rows = read_numeric_columns(path, COLUMNS, _MAX_BYTES)
    rows = rows[np.isfinite(rows[:, 0])]
    columns = dict(zip(COLUMNS, rows.T, strict=True))
    intervals = tuple(
        interval for before, after in pairwise(rows) if (interval := _interval(before, after)) is not None
    )
    cores = columns["cores"][np.isfinite(columns["cores"])]
    throttles = columns["throttles"][np.isfinite(columns["throttles"])]
    frequencies_hz = columns["frequency"][np.isfinite(columns["frequency"])]
    return HostLoad(
        cores=int(cores[-1]) if len(cores) else 0,
        intervals=intervals,
        throttle_events=max(0, int(throttles[-1] - throttles[0])) if len(throttles) else None,
        frequency_hz=float(frequencies_hz.mean()) if len(frequencies_hz) else None,
        not_measured=_not_measured(path),
    )


def host_metrics(load: HostLoad) -> dict[str, float]:
    """The metrics of the machine; what was not measured is absent."""
    throttles = None if load.throttle_events is None else float(load.throttle_events)
    values = {
        "disturbance.others_cores": load.mean("others_cores"),
        "disturbance.steal_fraction": load.mean("steal_fraction"),
        **{f"disturbance.{name}": load.mean(name) for name in _PRESSURES},
        "disturbance.throttle_events": throttles,
        "disturbance.cpu_frequency": load.frequency_hz,
    }
    return {key: value for key, value in values.items() if value is not None}


def _interval(before: FloatArray, after: FloatArray) -> HostInterval | None:
    step = dict(zip(COLUMNS, after - before, strict=True))
    duration_s = float(step["time"])
    if not duration_s > 0:
        return None
    others_s = _grown(step["busy"] - step["run"]) if np.isfinite(step["run"]) else None
    steal_s, cores = _grown(step["steal"]), float(after[COLUMNS.index("cores")])
    pressures = {name: _grown(step[name]) for name in _PRESSURES}
    return HostInterval(
        duration_s,
        others_cores=None if others_s is None else others_s / duration_s,
        steal_fraction=None if steal_s is None or not cores > 0 else min(1.0, steal_s / (cores * duration_s)),
        **{name: None if value is None else min(1.0, value / duration_s) for name, value in pressures.items()},
    )


def _grown(difference: float) -> float | None:
    """By how much a counter has grown, at least 0: two of them are not read at the same instant."""
    return max(0.0, float(difference)) if np.isfinite(difference) else None


def _not_measured(path: Path) -> tuple[str, ...]:
    data = read_untrusted_lines(path, _MAX_BYTES)
    if data is None:
        return ("the machine was not watched",)
    lines = data.decode("utf-8", errors="replace").splitlines()
    told = (line.removeprefix(NOT_MEASURED).strip() for line in lines if line.startswith(NOT_MEASURED))
    return tuple(dict.fromkeys(told))
