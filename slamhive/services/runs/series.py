"""Data of a run's plots as arrays, read from its folder: path, error, CPU, memory and latency."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamhive.base.bounds import read_record
from slamhive.base.errors import SlamHiveError
from slamhive.domain.dataset import Dataset
from slamhive.domain.protocol import protocol_from_content
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.played_frames import PlayedFrames, RecordingClock, read_played_frames
from slamhive.run_folder.untrusted import read_numeric_columns, read_untrusted_lines
from slamhive.services.evaluations import PROTOCOL_FILE
from slamhive.store.records import RunRecord

Array = NDArray[np.float64]
Places = NDArray[np.int64]

MAX_POINTS = 3000
"""A plot has no more points than this; a screen has no more columns."""
LIMIT_BYTES = 64_000_000
SAME_TIME_S = 1e-3
"""Timestamps that differ by less are of one pose: files round them."""


@dataclass(frozen=True, slots=True)
class PathSeries:
    """A path: ``times_s`` (n,), ``positions_m`` (n, 3). ``poses`` counts the poses before thinning.

    ``pieces`` (n,) numbers the pieces between gaps, so that a plot does not connect poses across a gap.
    """

    times_s: Array
    positions_m: Array
    poses: int
    pieces: Places

    def thinned(self, most: int) -> PathSeries:
        """At most ``most`` poses, evenly spaced, with the first and the last."""
        kept = self.even_places(most)
        return PathSeries(self.times_s[kept], self.positions_m[kept], self.poses, self.pieces[kept])

    def even_places(self, most: int) -> Places:
        """The poses that :meth:`thinned` keeps."""
        # No place comes twice: they are at least 1 apart before they are rounded down.
        found: Places = np.linspace(0, len(self.times_s) - 1, min(len(self.times_s), most)).astype(np.int64)
        return found


@dataclass(frozen=True, slots=True)
class Samples:
    """Values over time: ``times_s`` (n,) since the start of what is shown, ``values`` (n,).

    ``count`` is their number before thinning; ``pieces`` (n,) numbers the pieces between gaps. ``origin_s`` is the
    header timestamp from which the times count; None if they count from the start of the run. All data of a run that
    have an origin have the same, so their times are of one axis: the time of the recording.
    """

    times_s: Array
    values: Array
    count: int
    pieces: Places
    origin_s: float | None = None

    def thinned(self, most: int) -> Samples:
        """At most ``most`` samples, with every peak."""
        kept = thin_keeping_extremes(self.values, most)
        return replace(self, times_s=self.times_s[kept], values=self.values[kept], pieces=self.pieces[kept])


@dataclass(frozen=True, slots=True)
class RunSeries:
    """All plot data of one run. If a field is None, ``reasons`` explains why.

    ``estimate`` lies in the ground truth's frame where ``aligned``, in the algorithm's own otherwise. ``cpu`` is in
    cores, ``memory`` in bytes, ``error`` in m, ``latency`` in s. A gap in the estimate longer than ``gap_s`` is a
    gap; infinite where no protocol says how long that is. ``dropped_s`` (n,) are the times of dropped frames, and
    ``played_s`` those of the first and the last frame, in the time of the recording. ``played_s`` is None if it is not
    known when they were played.
    """

    estimate: PathSeries | None
    groundtruth: PathSeries | None
    aligned: bool
    gap_s: float
    error: Samples | None
    cpu: Samples | None
    memory: Samples | None
    latency: Samples | None
    dropped_s: Array
    played_s: tuple[float, float] | None
    reasons: dict[str, str]
    estimate_errors_m: Array | None = None
    """The position error of each pose of ``estimate``, (n,), NaN where none was matched; None if not evaluated."""

    @property
    def worst_s(self) -> float | None:
        """The header timestamp of the largest position error; None without errors."""
        if self.error is None or self.error.origin_s is None:
            return None
        return self.error.origin_s + float(self.error.times_s[int(self.error.values.argmax())])

    @property
    def start_s(self) -> float | None:
        """The header timestamp at which the time of the recording is 0; None if nothing is known over that time."""
        known = (self.error, self.latency, self.cpu, self.memory)
        return next((entry.origin_s for entry in known if entry is not None and entry.origin_s is not None), None)


class TrackFiles:
    """Reads each trajectory, and the errors of each evaluation, once for all views of a run that are made together."""

    def __init__(self) -> None:
        self.track = cache(read_whole_track)
        self.errors = cache(read_errors)


def run_series(
    run: RunRecord, folder: RunFolder, fingerprint: str | None = None, files: TrackFiles | None = None
) -> RunSeries:
    """Read the plot data of ``run`` and of an evaluation: the current one, or that with this fingerprint."""
    files = files or TrackFiles()
    estimate = groundtruth = errors = None
    gap_s = math.inf
    if fingerprint is None and run.protocol is not None:
        fingerprint = run.protocol.fingerprint
    if fingerprint is not None:
        evaluation = folder.evaluation(fingerprint)
        gap_s = gap_of(evaluation)
        estimate = _drawn(files.track(evaluation / "traj.tum", gap_s))
        groundtruth = _drawn(files.track(evaluation / "groundtruth.tum"))
        errors = files.errors(evaluation)
    aligned = estimate is not None
    frames = read_played_frames(folder.frames)
    # The time of the recording is 0 at its first frame, or at what is known of it otherwise.
    start_s = 0.0
    if frames is not None:
        start_s = float(frames.timestamps_s[0])
    elif groundtruth is not None:
        start_s = float(groundtruth.times_s[0])
    elif errors is not None:
        start_s = float(errors[0, 0])
    clock = None if frames is None else frames.clock((run.metrics or {}).get("startup"))
    usage = _columns(folder.profiling, ("time", "cpu_usage", "memory_usage"))
    found: dict[str, Any] = {
        "estimate": estimate or _drawn(files.track(folder.trajectory, gap_s)),
        "groundtruth": groundtruth,
        "error": None if errors is None else stamped_samples(errors[:, 0], errors[:, 1], start_s, gap_s),
        "cpu": None if usage is None else _usage_over_time(usage[:, 0], usage[:, 1], clock, start_s),
        "memory": None if usage is None else _usage_over_time(usage[:, 0], usage[:, 2], clock, start_s),
        "latency": None if frames is None else latency_of(frames, start_s),
    }
    latency: Samples | None = found["latency"]
    dropped_s: Array = np.empty(0)
    if frames is not None and latency is not None and latency.origin_s is not None:
        times_s = frames.dropped_timestamps_s() - latency.origin_s
        kept = np.unique(np.linspace(0, len(times_s) - 1, min(len(times_s), MAX_POINTS)).astype(np.int64))
        dropped_s = times_s[kept]
    if run.protocol is None:
        unevaluated = "The run has not been evaluated."
    elif run.metrics is not None and "ate.rmse" not in run.metrics:
        unevaluated = "The dataset has relations and no ground-truth trajectory."
    else:
        unevaluated = "The evaluation left no files to draw; evaluate again."
    if run.state.ended:
        unsampled = "CPU and memory were not sampled."
        no_path = "The run has left no trajectory that can be read."
        no_times = "The algorithm does not report when it takes and finishes a frame."
    else:
        unsampled = "CPU and memory have not been sampled yet."
        no_path = "The trajectory is written at the end of the run."
        no_times = "Frame times are written at the end of the run."
    explanations = {
        "estimate": no_path,
        "groundtruth": unevaluated,
        "error": unevaluated,
        "cpu": unsampled,
        "memory": unsampled,
        "latency": no_times,
    }
    pose_errors_m = None
    if estimate is not None and errors is not None:
        pose_errors_m = nearest_values(errors[:, 0], errors[:, 1], estimate.times_s, SAME_TIME_S)
    return RunSeries(
        **found,
        estimate_errors_m=pose_errors_m,
        aligned=aligned,
        gap_s=gap_s,
        dropped_s=dropped_s,
        played_s=None if clock is None else _ends(clock.timestamps_s - start_s),
        reasons={name: explanations[name] for name, data in found.items() if data is None},
    )


def _usage_over_time(run_times_s: Array, values: Array, clock: RecordingClock | None, start_s: float) -> Samples:
    """Sampled values over the time of the recording, or over that of the run without a clock."""
    if clock is None:
        return samples_of(run_times_s, values)
    return stamped_samples(clock.timestamps_at(run_times_s), values, start_s)


def _ends(times_s: Array) -> tuple[float, float]:
    return float(times_s[0]), float(times_s[-1])


def error_over_time(evaluation: Path, gap_s: float) -> Samples | None:
    """The position error of each matched pose, thinned for plotting; None if there is none."""
    error = read_errors(evaluation)
    return None if error is None else stamped_samples(error[:, 0], error[:, 1], float(error[0, 0]), gap_s)


def gap_of(evaluation: Path) -> float:
    """The gap threshold in the protocol of an evaluation, in s; infinite if unknown."""
    try:
        return protocol_from_content(read_record(evaluation / PROTOCOL_FILE)).gap_threshold_s
    except SlamHiveError:
        return math.inf


def read_errors(evaluation: Path) -> Array | None:
    """Timestamp in s and position error in m of each matched pose, shape (n, 2); None if there are none."""
    return _columns(evaluation / "errors.csv", ("timestamp", "ape_m"))


def read_dataset_path(dataset: Dataset) -> PathSeries | None:
    """The ground-truth path of a dataset; None if it has none or it cannot be read."""
    path = dataset.groundtruth_path
    return None if path is None else read_track(path)


def read_track(path: Path, gap_s: float = math.inf) -> PathSeries | None:
    """The TUM trajectory at ``path``, thinned for plotting; None if it is missing or malformed.

    A gap longer than ``gap_s`` starts a new piece.
    """
    return _drawn(read_whole_track(path, gap_s))


def _drawn(whole: PathSeries | None) -> PathSeries | None:
    return None if whole is None else whole.thinned(MAX_POINTS)


def read_whole_track(path: Path, gap_s: float = math.inf) -> PathSeries | None:
    """The same as :func:`read_track`, with every pose."""
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
    return PathSeries(rows[:, 0], rows[:, 1:], len(rows), _pieces(rows[:, 0], gap_s))


def thin_keeping_extremes(values: Array, most: int = MAX_POINTS) -> Places:
    """Indices of at most ``most`` values to keep: the smallest and largest of each interval, so that peaks remain."""
    if len(values) <= most:
        return np.arange(len(values))
    edges = np.linspace(0, len(values), most // 2 + 1).astype(int)
    chosen: list[int] = []
    for start, end in pairwise(edges.tolist()):
        stretch = values[start:end]
        chosen.extend(sorted({start + int(stretch.argmin()), start + int(stretch.argmax())}))
    return np.asarray(chosen)


def nearest_values(known_at_s: Array, values: Array, times_s: Array, most_s: float) -> Array:
    """The value that is nearest to each time; NaN if none is within ``most_s``."""
    if len(known_at_s) == 0:
        return np.full(len(times_s), np.nan)
    order = np.argsort(known_at_s, kind="stable")
    stamps_s, ordered = known_at_s[order], values[order]
    after = np.clip(np.searchsorted(stamps_s, times_s), 0, len(stamps_s) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(times_s - stamps_s[before] < stamps_s[after] - times_s, before, after)
    found: Array = np.where(np.abs(stamps_s[nearest] - times_s) <= most_s, ordered[nearest], np.nan)
    return found


def samples_of(times_s: Array, values: Array, gap_s: float = math.inf) -> Samples:
    """Values over time, thinned for plotting; a gap longer than ``gap_s`` starts a new piece."""
    return Samples(times_s, values, len(values), _pieces(times_s, gap_s)).thinned(MAX_POINTS)


def stamped_samples(timestamps_s: Array, values: Array, origin_s: float, gap_s: float = math.inf) -> Samples:
    """The same as :func:`samples_of`, over the time since the timestamp ``origin_s``."""
    return replace(samples_of(timestamps_s - origin_s, values, gap_s), origin_s=origin_s)


def _pieces(times_s: Array, gap_s: float) -> Places:
    return np.concatenate([[0], np.cumsum(np.diff(times_s) > gap_s)])


def _columns(path: Path, names: tuple[str, ...]) -> Array | None:
    """The named columns of a CSV file, shape (n, len(names)), without incomplete rows; None if unreadable."""
    rows = read_numeric_columns(path, names, LIMIT_BYTES)
    rows = rows[np.isfinite(rows).all(axis=1)]
    return rows if len(rows) else None


def latency_of(frames: PlayedFrames, origin_s: float) -> Samples | None:
    """From a frame's arrival to its result, over the time since the timestamp ``origin_s``.

    Dropped frames have no latency; None if no frame has one.
    """
    timestamps_s, latencies_s = frames.latencies()
    return stamped_samples(timestamps_s, latencies_s, origin_s) if len(timestamps_s) else None
