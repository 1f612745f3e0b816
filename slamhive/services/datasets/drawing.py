"""Draws the ground truth of a dataset with matplotlib, for ``slamhive dataset show --plot``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from slamhive.domain.dataset import Dataset
from slamhive.errors import Unavailable
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.motion import Motion

_AXES = "xyz"
_LINE, _START, _END = "#0072B2", "#009E73", "#D55E00"


def draw_motion(dataset: Dataset, truth: Trajectory, motion: Motion, target: Path) -> None:
    """Write the picture: the path in the plane of its two largest extents, then speed and angular rate over time."""
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
