"""The plots of the published SLAM Hive, drawn by evo: trajectory, coordinates and angles, errors over time."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from evo.core.result import Result
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import plot
from matplotlib.figure import Figure

from slamhive.base.files import write_aside
from slamhive.evaluation.evaluators.base import Paired
from slamhive.evaluation.evaluators.evo_errors import ESTIMATE_NAME, REFERENCE_NAME, evo_pair
from slamhive.trajectory.model import FloatArray

_SIZE_INCHES = (8.0, 6.0)
_DOTS_PER_INCH = 110
_REFERENCE_STYLE = {"style": "--", "color": "#444444", "label": "ground truth"}
_ESTIMATE_STYLE = {"style": "-", "color": "#0072B2", "label": ESTIMATE_NAME}
_LINES = ("rmse", "mean", "median", "std")


def write_plots(folder: Path, paired: Paired, archives: Mapping[str, Result]) -> None:
    """Write every plot of the evaluation as a PNG, each in one step. Raises Unavailable."""
    matched, aligned = evo_pair(paired)
    ape = archives["ape"]
    plane = _widest_plane(matched.positions_xyz)
    drawings: dict[str, Callable[[Figure], None]] = {
        "traj_trajectories": lambda figure: _trajectories(figure, matched, aligned, plane),
        "traj_xyz": lambda figure: _over_time(figure, matched, aligned, plot.traj_xyz),
        "traj_rpy": lambda figure: _over_time(figure, matched, aligned, plot.traj_rpy),
        "traj_speeds": lambda figure: _speeds(figure, matched, aligned),
        "ape_raw": lambda figure: _errors(figure, ape),
        "ape_map": lambda figure: _error_map(figure, matched, aligned, ape, plane),
    }
    pairs = archives.get("rpe")
    if pairs is not None:
        ends, reference_ends = pairs.trajectories[ESTIMATE_NAME], pairs.trajectories[REFERENCE_NAME]
        drawings["rpe_raw"] = lambda figure: _errors(figure, pairs)
        drawings["rpe_map"] = lambda figure: _error_map(figure, reference_ends, ends, pairs, plane)
    for name, draw in drawings.items():
        buffer = io.BytesIO()
        figure = plt.figure(figsize=_SIZE_INCHES)
        try:
            draw(figure)
            figure.savefig(buffer, format="png", dpi=_DOTS_PER_INCH)
        finally:
            plt.close(figure)
        write_aside(folder / f"{name}.png", buffer.getvalue())


def _widest_plane(positions_m: FloatArray) -> plot.PlotMode:
    """The plane of the two coordinates that change most; z does not point up in camera frames."""
    extents_m = np.ptp(positions_m, axis=0)
    flattest = int(extents_m.argmin())
    return (plot.PlotMode.yz, plot.PlotMode.xz, plot.PlotMode.xy)[flattest]


def _trajectories(figure: Figure, matched: PoseTrajectory3D, aligned: PoseTrajectory3D, plane: plot.PlotMode) -> None:
    axes = plot.prepare_axis(figure, plane)
    plot.traj(axes, plane, matched, **_REFERENCE_STYLE)
    plot.traj(axes, plane, aligned, plot_start_end_markers=True, **_ESTIMATE_STYLE)
    axes.legend()


def _over_time(figure: Figure, matched: PoseTrajectory3D, aligned: PoseTrajectory3D, draw: Callable[..., None]) -> None:
    axes = figure.subplots(3, sharex="col")
    start_s = matched.timestamps[0]
    draw(axes, matched, start_timestamp=start_s, **_REFERENCE_STYLE)
    draw(axes, aligned, start_timestamp=start_s, **_ESTIMATE_STYLE)


def _speeds(figure: Figure, matched: PoseTrajectory3D, aligned: PoseTrajectory3D) -> None:
    axes = figure.add_subplot()
    start_s = matched.timestamps[0]
    plot.speeds(axes, _each_time_once(matched), start_timestamp=start_s, **_REFERENCE_STYLE)
    plot.speeds(axes, _each_time_once(aligned), start_timestamp=start_s, **_ESTIMATE_STYLE)
    axes.legend()


def _each_time_once(trajectory: PoseTrajectory3D) -> PoseTrajectory3D:
    """The poses without repeated timestamps: two poses at one time have no speed."""
    later = np.flatnonzero(np.diff(trajectory.timestamps, prepend=-np.inf) > 0)
    return PoseTrajectory3D(
        trajectory.positions_xyz[later], trajectory.orientations_quat_wxyz[later], trajectory.timestamps[later]
    )


def _errors(figure: Figure, result: Result) -> None:
    plot.error_array(
        figure.add_subplot(),
        result.np_arrays["error_array"],
        x_array=result.np_arrays["seconds_from_start"],
        statistics={name: result.stats[name] for name in _LINES},
        name=result.info["label"],
        title=result.info["title"],
        xlabel="$t$ (s)",
    )


def _error_map(
    figure: Figure, reference: PoseTrajectory3D, estimate: PoseTrajectory3D, result: Result, plane: plot.PlotMode
) -> None:
    axes = plot.prepare_axis(figure, plane)
    plot.traj(axes, plane, reference, **_REFERENCE_STYLE)
    plot.traj_colormap(
        axes,
        estimate,
        result.np_arrays["error_array"],
        plane,
        min_map=result.stats["min"],
        max_map=result.stats["max"],
        title=result.info["title"],
        fig=figure,
    )
    axes.legend()
