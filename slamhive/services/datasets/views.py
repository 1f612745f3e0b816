"""Views of a dataset: frames, LiDAR sweeps, and the motion in its ground truth."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from cachetools import LRUCache

from slamhive.base.errors import InvalidInput, NotFound, Unavailable
from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.recordings.views import (
    FRAME_WIDTH,
    THUMBNAIL_WIDTH,
    FrameView,
    SweepView,
    frames_at,
    received_s,
    sweep_at,
)
from slamhive.services.kept_answers import KeptViews
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import Motion, motion_of

THUMBNAILS = 12
_CACHE_BYTES = 32_000_000
_MOTIONS = 256
"""How many summaries of a ground truth are kept."""
View = TypeVar("View", FrameView, SweepView)
_Key = tuple[str, str, str, int, int]
_Stamp = tuple[Path, GroundTruth | None, int, int]


def strip_times_s(dataset: Dataset) -> list[float]:
    """The times of the frames that give an overview, evenly spaced over the recording."""
    return [round((number + 0.5) * dataset.duration_s / THUMBNAILS, 3) for number in range(THUMBNAILS)]


class DatasetViews:
    """Frames and sweeps, read from recordings on demand.

    Those shown last are kept in memory, up to 32 MB. At most two recordings are read at once, so visitors who click
    quickly wait, and runs keep their CPU.
    """

    def __init__(self) -> None:
        self._kept: KeptViews[_Key, FrameView | SweepView] = KeptViews(_CACHE_BYTES, _size_bytes)
        self._motions: LRUCache[_Stamp, MotionSummary | None] = LRUCache(_MOTIONS)
        self._lock = threading.Lock()

    def frame(self, dataset: Dataset, sensor: str, time_s: float) -> FrameView:
        """The first frame of a camera at or after ``time_s`` from the start of the recording.

        Raises NotFound for a sensor that is no camera or a time after the last frame, InvalidInput for a damaged
        recording.
        """
        camera = dataset.sensor(sensor)

        def read() -> FrameView:
            for view in frames_at(dataset, camera, [time_s], FRAME_WIDTH):
                return view
            raise _after_the_end(dataset, sensor, time_s)

        return self._view(_key(dataset, sensor, time_s, FRAME_WIDTH), read)

    def received_s(self, dataset: Dataset, sensor: str, timestamp_s: float) -> float | None:
        """The time that :meth:`frame` and :meth:`sweep` take for the message with this header timestamp, or the next.

        None after the last message. Raises as :meth:`frame`.
        """
        with self._kept.turns:
            return received_s(dataset, dataset.sensor(sensor), timestamp_s)

    def thumbnail(self, dataset: Dataset, sensor: str, number: int) -> FrameView:
        """Frame ``number`` of the overview, see :func:`strip_times_s`; all of them are read together."""
        times_s = strip_times_s(dataset)
        if not 0 <= number < len(times_s):
            raise NotFound(f"the overview has {len(times_s)} frames, none with the number {number}")
        camera = dataset.sensor(sensor)

        def read() -> FrameView:
            views = list(frames_at(dataset, camera, times_s, THUMBNAIL_WIDTH))
            for time_s, view in zip(times_s, views, strict=False):
                self._kept.put(_key(dataset, sensor, time_s, THUMBNAIL_WIDTH), view)
            if number >= len(views):
                raise _after_the_end(dataset, sensor, times_s[number])
            return views[number]

        return self._view(_key(dataset, sensor, times_s[number], THUMBNAIL_WIDTH), read)

    def sweep(self, dataset: Dataset, sensor: str, time_s: float) -> SweepView:
        """The first sweep of a LiDAR at or after ``time_s``; raises as :meth:`frame`."""
        lidar = dataset.sensor(sensor)

        def read() -> SweepView:
            view = sweep_at(dataset, lidar, time_s)
            if view is None:
                raise _after_the_end(dataset, sensor, time_s)
            return view

        return self._view(_key(dataset, sensor, time_s, 0), read)

    def motion(self, dataset: Dataset) -> MotionSummary | None:
        """Summarise the motion like :func:`motion_summary`, but read an unchanged ground truth only once."""
        path = dataset.groundtruth_path
        try:
            status = None if path is None else path.stat()
        except FileNotFoundError:
            status = None
        if path is None or status is None:
            return motion_summary(dataset)
        key = (path, dataset.groundtruth, status.st_mtime_ns, status.st_size)
        with self._lock:
            known = key in self._motions
            summary = self._motions[key] if known else None
        if not known:
            summary = motion_summary(dataset)
            with self._lock:
                self._motions[key] = summary
        return summary

    def _view(self, key: _Key, read: Callable[[], View]) -> View:
        return self._kept.get(key, read)  # type: ignore[return-value]  # a key belongs to one kind of view


def read_ground_truth(dataset: Dataset) -> Trajectory | None:
    """The ground truth of a dataset, None without; raises InvalidInput or NotFound for a file that cannot be read."""
    path = dataset.groundtruth_path
    return None if path is None else read_tum(path)


@dataclass(frozen=True, slots=True)
class MotionSummary:
    """The motion in a ground truth.

    Attributes:
        poses: How many poses it has.
        span_s: Time from the first pose to the last.
        length_m: Length of the path.
        mean_speed_mps: ``length_m`` by ``span_s``; None for a single pose.
        max_speed_mps: The largest speed over 0.2 s; None where there are no two poses that close.
        max_angular_rate_radps: The largest angular rate over 0.2 s; None where orientations are unknown as well.
    """

    poses: int
    span_s: float
    length_m: float
    mean_speed_mps: float | None
    max_speed_mps: float | None
    max_angular_rate_radps: float | None


def motion_summary(dataset: Dataset) -> MotionSummary | None:
    """The motion in the ground truth of a dataset, None without one; raises as :func:`read_ground_truth`."""
    truth = read_ground_truth(dataset)
    if truth is None or dataset.groundtruth is None:
        return None
    motion = motion_of(truth)
    known = len(motion.times_s) > 0
    turns = known and not dataset.groundtruth.positions_only
    return MotionSummary(
        poses=len(truth),
        span_s=truth.span_s,
        length_m=truth.path_length_m,
        mean_speed_mps=truth.path_length_m / truth.span_s if truth.span_s > 0 else None,
        max_speed_mps=float(motion.speeds_mps.max()) if known else None,
        max_angular_rate_radps=float(motion.angular_rates_radps.max()) if turns else None,
    )


def draw_ground_truth(dataset: Dataset, target: Path) -> None:
    """Draw path, speed and angular rate as a picture; the ending of ``target`` names its kind: png, svg, pdf.

    Raises NotFound for a dataset without ground truth, InvalidInput for an ending that is none of these.
    """
    truth = read_ground_truth(dataset)
    if truth is None or dataset.groundtruth is None:
        raise NotFound(f"dataset {dataset.name} has no ground truth to draw")
    if target.suffix not in {".png", ".svg", ".pdf"}:
        raise InvalidInput(f"{target} has the ending {target.suffix!r}", "use .png, .svg or .pdf")

    motion = motion_of(truth)
    draw_motion(dataset, truth, motion, target)


def ground_truth_motion(dataset: Dataset) -> Motion | None:
    """Speed and angular rate over the ground truth, None without one; raises as :func:`read_ground_truth`."""
    truth = read_ground_truth(dataset)
    return None if truth is None else motion_of(truth)


def _key(dataset: Dataset, sensor: str, time_s: float, width: int) -> _Key:
    return (dataset.name, dataset.checksum, sensor, round(time_s * 1000), width)


def _size_bytes(view: FrameView | SweepView) -> int:
    return len(view.jpeg) if isinstance(view, FrameView) else int(view.positions_m.nbytes)


def _after_the_end(dataset: Dataset, sensor: str, time_s: float) -> NotFound:
    return NotFound(
        f"sensor {sensor} of dataset {dataset.name} has nothing at {time_s:.3f} s or later",
        f"the recording lasts {dataset.duration_s:.3f} s",
    )


# The plot of ``slamhive dataset show --plot``.

_AXES = "xyz"
_LINE, _START, _END = "#0072B2", "#009E73", "#D55E00"


def draw_motion(dataset: Dataset, truth: Trajectory, motion: Motion, target: Path) -> None:
    """Write the picture: the path in the plane of its two largest extents, then speed and angular rate over time."""
    # The pages import this module and draw nothing; matplotlib takes half a second.
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(10, 6), layout="constrained")
    figure.suptitle(f"{dataset.name}: {truth.path_length_m:.1f} m in {truth.span_s:.1f} s, {len(truth)} poses")
    positions_only = dataset.groundtruth is not None and dataset.groundtruth.positions_only
    grid = figure.add_gridspec(1 if positions_only else 2, 2, width_ratios=(1.3, 1))
    path = figure.add_subplot(grid[:, 0])
    dropped = int(np.argmin(np.ptp(truth.positions_m, axis=0)))
    first, second = (axis for axis in range(3) if axis != dropped)
    points_m = truth.positions_m[:, (first, second)]
    path.plot(*points_m.T, color=_LINE, linewidth=1.2)
    path.plot(*points_m[0], "o", color=_START, fillstyle="none", markersize=9, label="start")
    path.plot(*points_m[-1], "s", color=_END, label="end")
    path.set(xlabel=f"{_AXES[first]} [m]", ylabel=f"{_AXES[second]} [m]", aspect="equal", adjustable="datalim")
    path.legend(frameon=False)
    curves = [("speed [m/s]", motion.speeds_mps)]
    if not positions_only:
        curves.append(("angular rate [rad/s]", motion.angular_rates_radps))
    for row, (title, values) in enumerate(curves):
        axes = figure.add_subplot(grid[row, 1])
        axes.plot(motion.times_s - truth.stamps_s[0], values, color=_LINE, linewidth=1)
        axes.set(xlabel="time since the first pose [s]", ylabel=title)
        axes.set_ylim(bottom=0)
    for axes in figure.axes:
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    try:
        figure.savefig(target, dpi=150)
    except OSError as error:
        raise Unavailable(f"{target} cannot be written: {error.strerror}", "name another file") from None
