"""What the figures of a run show, as arrays: path, error, CPU and memory, latency. Read from its folder."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamhive.domain.dataset import Dataset
from slamhive.runs.folder import RunFolder
from slamhive.runs.untrusted import read_numeric_columns, read_untrusted_lines
from slamhive.store.records import RunRecord

Array = NDArray[np.float64]

MAX_POINTS = 3000
"""A figure draws no more points than this; a screen has no more columns."""
LIMIT_BYTES = 64_000_000


@dataclass(frozen=True, slots=True)
class Track:
    """A path: ``times_s`` (n,), ``positions_m`` (n, 3). ``poses`` counts them before thinning."""

    times_s: Array
    positions_m: Array
    poses: int


@dataclass(frozen=True, slots=True)
class Samples:
    """Values over time: ``times_s`` (n,) since the start of what is shown, ``values`` (n,).

    ``count`` is their number before thinning.
    """

    times_s: Array
    values: Array
    count: int


@dataclass(frozen=True, slots=True)
class RunSeries:
    """All figure data of one run. What is None is explained in ``reasons`` under the same name.

    ``estimate`` lies in the ground truth's frame where ``aligned``, in the algorithm's own otherwise. ``cpu`` is in
    cores, ``memory`` in bytes, ``error`` in m, ``latency`` in s.
    """

    estimate: Track | None
    groundtruth: Track | None
    aligned: bool
    error: Samples | None
    cpu: Samples | None
    memory: Samples | None
    latency: Samples | None
    reasons: dict[str, str]


def run_series(run: RunRecord, folder: RunFolder) -> RunSeries:
    """Read everything that can be drawn of ``run``, the evaluation being the one whose figures it shows."""
    estimate = groundtruth = error = None
    if run.protocol is not None:
        evaluation = folder.evaluation(run.protocol.fingerprint)
        estimate = read_track(evaluation / "traj.tum")
        groundtruth = read_track(evaluation / "groundtruth.tum")
        error = _columns(evaluation / "errors.csv", ("timestamp", "ape_m"))
    aligned = estimate is not None
    usage = _columns(folder.profiling, ("time", "cpu_usage", "memory_usage"))
    found: dict[str, Any] = {
        "estimate": estimate or read_track(folder.trajectory),
        "groundtruth": groundtruth,
        "error": None if error is None else _samples(error[:, 0] - error[0, 0], error[:, 1]),
        "cpu": None if usage is None else _samples(usage[:, 0], usage[:, 1]),
        "memory": None if usage is None else _samples(usage[:, 0], usage[:, 2]),
        "latency": _latency(folder.frames),
    }
    explanations = _explanations(run)
    reasons = {name: explanations[name] for name, data in found.items() if data is None}
    return RunSeries(**found, aligned=aligned, reasons=reasons)


def _explanations(run: RunRecord) -> dict[str, str]:
    """Why each kind of data is not there, if it is not."""
    if run.protocol is None:
        evaluation = "The run has not been evaluated."
    elif run.metrics is not None and "ate.rmse" not in run.metrics:
        evaluation = "The dataset has relations and no ground-truth trajectory."
    else:
        evaluation = "The evaluation left no files to draw; evaluate again."
    sampled = "CPU and memory were not sampled." if run.state.ended else "CPU and memory have not been sampled yet."
    if run.state.ended:
        estimate = "The run has left no trajectory that can be read."
        latency = "The algorithm does not report when it takes and finishes a frame."
    else:
        estimate = "The trajectory is written at the end of the run."
        latency = "Frame times are written at the end of the run."
    return {
        "estimate": estimate,
        "groundtruth": evaluation,
        "error": evaluation,
        "cpu": sampled,
        "memory": sampled,
        "latency": latency,
    }


def read_dataset_path(dataset: Dataset) -> Track | None:
    """The ground-truth path of a dataset, None if it has none that can be read."""
    path = dataset.groundtruth_path
    return None if path is None else read_track(path)


def read_track(path: Path) -> Track | None:
    """The TUM trajectory at ``path``, thinned for drawing; None if there is none or it is malformed."""
    data = read_untrusted_lines(path, LIMIT_BYTES)
    if not data:
        return None
    lines = [line for line in data.decode(errors="replace").splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        return None
    try:
        rows = np.loadtxt(lines, ndmin=2, usecols=(0, 1, 2, 3), dtype=np.float64)
    except ValueError:
        return None
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) == 0:
        return None
    kept = rows[_evenly(len(rows))]
    return Track(kept[:, 0], kept[:, 1:], len(rows))


def thin_keeping_extremes(times_s: Array, values: Array, most: int = MAX_POINTS) -> tuple[Array, Array]:
    """At most ``most`` points; each stretch keeps its smallest and its largest value, so that no peak disappears."""
    if len(values) <= most:
        return times_s, values
    edges = np.linspace(0, len(values), most // 2 + 1).astype(int)
    chosen: list[int] = []
    for start, end in pairwise(edges.tolist()):
        stretch = values[start:end]
        chosen.extend(sorted({start + int(stretch.argmin()), start + int(stretch.argmax())}))
    return times_s[chosen], values[chosen]


def _samples(times_s: Array, values: Array) -> Samples:
    thinned_s, thinned = thin_keeping_extremes(times_s, values)
    return Samples(thinned_s, thinned, len(values))


def _evenly(count: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, min(count, MAX_POINTS)).astype(np.int64))


def _columns(path: Path, names: tuple[str, ...]) -> Array | None:
    """The named columns of a CSV file as (n, len(names)), rows with a missing value left out; None if unreadable."""
    rows = read_numeric_columns(path, names, LIMIT_BYTES)
    rows = rows[np.isfinite(rows).all(axis=1)]
    return rows if len(rows) else None


def _latency(path: Path) -> Samples | None:
    """From a frame's arrival to its result, over the recording's time; dropped frames have none."""
    rows = _columns(path, ("timestamp", "received", "done"))
    if rows is None:
        return None
    rows = rows[rows[:, 2] >= rows[:, 1]]
    if len(rows) == 0:
        return None
    return _samples(rows[:, 0] - rows[0, 0], rows[:, 2] - rows[:, 1])
