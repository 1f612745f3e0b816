"""The metrics that were measured during a run, and two plots of CPU and memory over time."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import numpy as np

from slamhive.base.files import write_aside
from slamhive.domain.trust import HostInterval, HostLoad
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.host_columns import COLUMNS, NOT_MEASURED
from slamhive.run_folder.outcome import Evidence
from slamhive.run_folder.untrusted import (
    FloatArray,
    measured_number,
    read_numeric_columns,
    read_untrusted_json,
    read_untrusted_lines,
)

# Reads ``host.csv``, the counters of the machine during a run.
#
# The counters only grow, so a gap between two lines, as when the worker restarts, costs nothing but resolution.


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
    data = read_untrusted_lines(path, _MAX_BYTES)
    not_measured: tuple[str, ...] = ("the machine was not watched",)
    if data is not None:
        lines = data.decode("utf-8", errors="replace").splitlines()
        told = (line.removeprefix(NOT_MEASURED).strip() for line in lines if line.startswith(NOT_MEASURED))
        not_measured = tuple(dict.fromkeys(told))
    return HostLoad(
        cores=int(cores[-1]) if len(cores) else 0,
        intervals=intervals,
        throttle_events=max(0, int(throttles[-1] - throttles[0])) if len(throttles) else None,
        frequency_hz=float(frequencies_hz.mean()) if len(frequencies_hz) else None,
        not_measured=not_measured,
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


_MAX_CSV_BYTES = 200_000_000
_MAX_JSON_BYTES = 1_000_000
_LONGEST_ENERGY_GAP_S = 10.0
_PLOT_INCHES = (8.0, 3.2)
_PLOT_AREA = (0.1, 0.15, 0.88, 0.81)
"""Left, bottom, width and height in shares of the picture: finding them for each plot takes as long as drawing it."""
_CPU_COLOUR = "#0072B2"
_RAM_COLOUR = "#D55E00"


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """``profiling.csv`` as arrays of shape (n,): end of each interval (s since start), cores in use, bytes."""

    times_s: FloatArray
    cpu_cores: FloatArray
    memory_bytes: FloatArray

    def __len__(self) -> int:
        return int(self.times_s.shape[0])

    @property
    def weights_s(self) -> FloatArray:
        """The time that each sample stands for: the time since the one before, at most five times the usual interval.

        The first sample, and one behind a gap (the worker was restarted), know no sample before them; they stand for
        the usual interval, the median of all.
        """
        if len(self) < 2:
            return np.ones(len(self))
        steps_s = np.diff(self.times_s)
        usual_s = float(np.median(steps_s))
        weights_s = np.concatenate(([usual_s], steps_s))
        return np.where((weights_s > 5 * usual_s) | (weights_s < 0), usual_s, weights_s)


def read_profile(path: Path) -> Profile:
    """Read ``profiling.csv``; a missing file has no samples, a line that is not three numbers is skipped."""
    rows = read_numeric_columns(path, ("time", "cpu_usage", "memory_usage"), _MAX_CSV_BYTES)
    return Profile(rows[:, 0], rows[:, 1], rows[:, 2])


def measure_run(
    folder: RunFolder,
    started_at: datetime,
    ended_at: datetime,
    kernel_totals: Mapping[str, float],
    evidence: Evidence,
) -> dict[str, float]:
    """The metrics of a run that need no evaluation, keyed as in :mod:`slamhive.domain.metrics`.

    What could not be measured is absent.

    Args:
        folder: The run's folder.
        started_at: When the algorithm started.
        ended_at: When it ended.
        kernel_totals: Metrics that the kernel itself recorded over the whole run, such as its peak of memory.
        evidence: What is known of the end.
    """
    duration_s = (ended_at - started_at).total_seconds()
    metrics = {"duration": duration_s}
    if evidence.trajectory.poses is not None:
        metrics["poses"] = float(evidence.trajectory.poses)
    profile = read_profile(folder.profiling)
    if len(profile) > 0:
        weights_s = profile.weights_s
        metrics["cpu.mean"] = float(np.average(profile.cpu_cores, weights=weights_s))
        metrics["cpu.p95"] = weighted_percentile(profile.cpu_cores, weights_s, 95)
        metrics["cpu.max"] = float(profile.cpu_cores.max())
        metrics["ram.mean"] = float(np.average(profile.memory_bytes, weights=weights_s))
        metrics["ram.max"] = float(profile.memory_bytes.max())
    metrics.update(kernel_totals)
    metrics.update(_frame_metrics(folder.frames, profile))
    metrics.update(_energy_metrics(folder.energy, duration_s))
    metrics.update(_gpu_metrics(folder.gpu))
    metrics.update(_playback_metrics(folder.playback, started_at, duration_s))
    metrics.update(_localisation_metrics(folder.localisation))
    metrics.update(host_metrics(read_host_load(folder.host)))
    return {key: value for key, value in metrics.items() if math.isfinite(value)}


def limit_metrics(metrics: Mapping[str, float], cores: float | None) -> dict[str, float]:
    """Return the share of its limit of CPU cores that a run used; empty without a limit or a measurement."""
    used = metrics.get("cpu.mean")
    return {} if used is None or not cores else {"cpu.limit_used": used / cores}


def weighted_percentile(values: FloatArray, weights: FloatArray, percent: float) -> float:
    """The smallest value that ``percent`` of the weight does not exceed (inverse of the weighted distribution)."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    index = int(np.searchsorted(cumulative, percent / 100.0 * cumulative[-1]))
    return float(values[order][min(index, len(values) - 1)])


def write_plots(folder: RunFolder) -> None:
    """Write ``profiling_cpu.png`` and ``profiling_ram.png``; nothing without two samples. Raises Unavailable."""
    found = read_profile(folder.profiling)
    rows = np.stack([found.times_s, found.cpu_cores, found.memory_bytes])
    profile = Profile(*rows[:, np.isfinite(rows).all(axis=0)])  # those of imported archives hold anything
    if len(profile) < 2:
        return
    cpu = _plot(profile.times_s, profile.cpu_cores, "CPU in cores", _CPU_COLOUR)
    write_aside(folder.profiling_cpu_plot, cpu)
    ram = _plot(profile.times_s, profile.memory_bytes / 1e6, "Memory in MB", _RAM_COLOUR)
    write_aside(folder.profiling_ram_plot, ram)


def plots_are_missing(folder: RunFolder) -> bool:
    """Return whether there is something to plot that :func:`write_plots` has not plotted."""
    plots = (folder.profiling_cpu_plot, folder.profiling_ram_plot)
    return folder.profiling.is_file() and not all(plot.exists() for plot in plots)


def _frame_metrics(path: Path, profile: Profile) -> dict[str, float]:
    """Dropped frames, latencies, missed deadlines, CPU time by data from ``timestamp,received,done,dropped``."""
    rows = read_numeric_columns(path, ("timestamp", "received", "done", "dropped"), _MAX_CSV_BYTES)
    if len(rows) == 0:
        return {}
    dropped = rows[:, 3] != 0
    metrics = {
        "frames.dropped": float(np.count_nonzero(dropped)),
        "frames.dropped_fraction": float(np.mean(dropped)),
    }
    latencies_s = (rows[:, 2] - rows[:, 1])[~dropped]
    latencies_s = latencies_s[np.isfinite(latencies_s) & (latencies_s >= 0)]
    steps_s = np.diff(np.sort(rows[np.isfinite(rows[:, 0]), 0]))
    answered = len(latencies_s) + metrics["frames.dropped"]
    if len(steps_s) > 0 and np.median(steps_s) > 0 and answered > 0:
        late = np.count_nonzero(latencies_s > np.median(steps_s)) + metrics["frames.dropped"]
        metrics["deadline.missed_fraction"] = float(late / answered)
    if len(profile) > 0 and steps_s.sum() > 0:
        metrics["cpu.per_data_second"] = float((profile.cpu_cores * profile.weights_s).sum() / steps_s.sum())
    if len(latencies_s) > 0:
        metrics["latency.median"] = float(np.median(latencies_s))
        metrics["latency.p95"] = float(np.percentile(latencies_s, 95))
        metrics["latency.max"] = float(latencies_s.max())
    return metrics


def _energy_metrics(path: Path, run_duration_s: float) -> dict[str, float]:
    """Joules between the first and the last reading of ``energy.csv``, which must cover the run without a gap.

    Counters that begin again are followed as long as no time is missing in which they could have done so twice.
    """
    rows = read_numeric_columns(path, ("time", "package", "energy_uj", "range_uj"), _MAX_CSV_BYTES)
    rows = rows[np.isfinite(rows).all(axis=1)]
    total_uj = 0.0
    for package in np.unique(rows[:, 1]):
        times_s, _, counts_uj, ranges_uj = rows[rows[:, 1] == package].T
        edges_s = np.concatenate(([0.0], times_s, [run_duration_s]))
        if len(times_s) < 2 or np.diff(edges_s).max() > _LONGEST_ENERGY_GAP_S:
            return {}
        steps_uj = np.diff(counts_uj)
        total_uj += float(np.where(steps_uj < 0, steps_uj + ranges_uj[1:], steps_uj).sum())
    return {"energy": total_uj * 1e-6} if total_uj > 0 else {}


def _gpu_metrics(path: Path) -> dict[str, float]:
    """Peak and mean of the samples in ``gpu.csv``; the driver's samples have equal intervals."""
    rows = read_numeric_columns(path, ("time", "memory_bytes", "utilisation"), _MAX_CSV_BYTES)
    memory_bytes, utilisation = (column[np.isfinite(column)] for column in (rows[:, 1], rows[:, 2]))
    metrics: dict[str, float] = {}
    if len(memory_bytes) > 0:
        metrics["gpu.memory_max"] = float(memory_bytes.max())
        metrics["gpu.memory_mean"] = float(memory_bytes.mean())
    if len(utilisation) > 0:
        metrics["gpu.utilisation_mean"] = float(utilisation.mean())
        metrics["gpu.utilisation_max"] = float(utilisation.max())
    return metrics


def _playback_metrics(path: Path, started_at: datetime, run_duration_s: float) -> dict[str, float]:
    """The player's own share, its lag, and when it began, from ``playback.json``.

    The share has the bounds of ``cpu.mean``: all CPU time of the player's process, its start included, over the whole
    run. So it is a part of ``cpu.mean``, and the difference is the algorithm's. The algorithm and the executor read the
    clock of one machine; a beginning outside the run, as after that clock was set, is left out.
    """
    content = read_untrusted_json(path, _MAX_JSON_BYTES) or {}
    metrics: dict[str, float] = {}
    cpu_s = measured_number(content.get("cpu_s"))
    if cpu_s is not None and run_duration_s > 0:
        metrics["cpu.player_mean"] = cpu_s / run_duration_s
    lag_s = measured_number(content.get("lag_max_s"))
    if lag_s is not None:
        metrics["playback.lag_max"] = lag_s
    began_at_s = measured_number(content.get("began_at_s"))
    if began_at_s is not None and 0 <= began_at_s - started_at.timestamp() <= run_duration_s:
        metrics["startup"] = began_at_s - started_at.timestamp()
    # The sum over all queues is not known if one of them says no number.
    queues = content.get("queues")
    if isinstance(queues, list) and queues:
        counts = [measured_number(queue.get("dropped")) if isinstance(queue, dict) else None for queue in queues]
        known = [count for count in counts if count is not None]
        if len(known) == len(counts):
            metrics["queues.dropped"] = sum(known)
    return metrics


def _localisation_metrics(path: Path) -> dict[str, float]:
    """Return the time and number of localisations in the map that the run started with, from ``localisation.json``."""
    content = read_untrusted_json(path, _MAX_JSON_BYTES) or {}
    names = ("first_frame_s", "localised_at_s", "frames", "frames_localised")
    first_s, localised_at_s, frames, localised = (measured_number(content.get(name)) for name in names)
    metrics: dict[str, float] = {}
    if frames and localised is not None and localised <= frames:
        metrics["map.localised_fraction"] = localised / frames
    if first_s is not None and localised_at_s is not None and localised_at_s >= first_s:
        metrics["map.localisation_time"] = localised_at_s - first_s
    return metrics


def _plot(times_s: FloatArray, values: FloatArray, label: str, colour: str) -> bytes:
    """A PNG of ``values`` over time; matplotlib's object interface, which keeps no global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - half a second, for plots only
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=_PLOT_INCHES)
    FigureCanvasAgg(figure)
    axes = figure.add_axes(_PLOT_AREA)
    axes.plot(times_s, values, color=colour, linewidth=0.9)
    axes.fill_between(times_s, values, color=colour, alpha=0.15, linewidth=0)
    axes.set_xlabel("Time since start in s")
    axes.set_ylabel(label)
    axes.set_xlim(0, max(float(times_s[-1]), 0.1))
    axes.set_ylim(0, max(float(np.nanmax(values)) * 1.1, 1e-3))
    axes.grid(visible=True, alpha=0.3)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return stream.getvalue()
