"""The interactive plots of runs and datasets, as the JSON that Plotly reads.

Pages draw curves and planes of it with ``curves.js`` and ``planes.js``; Plotly draws paths in space on static sites.
Scripts fill in light or dark colours. Traces may carry what only our scripts read: ``times_s``, ``errors_m``, ``run``.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slamhive.analysis.plotly_chart import THEMED, numbers, translucent, with_dark_colours
from slamhive.base.errors import NotFound
from slamhive.documents.catalogue import TruthTrialDocument
from slamhive.recordings.views import SweepView
from slamhive.services.runs import Array, PathSeries, Places, RunSeries, Samples, samples_of
from slamhive.trajectory.transforms import Motion
from slamhive.web.formatting import plural, significant, thousands

PLANES = {"xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
AXES = "xyz"
Figure = dict[str, Any]
Values = Array | list[float]
MOST_INTERVALS = 300
"""Of dropped frames over time."""
_RECORDING_TIME = "recording time [s]"


def best_plane(track: PathSeries) -> str:
    """The plane spanned by the two largest extents of the path."""
    extents = np.ptp(track.positions_m, axis=0)
    dropped = int(np.argmin(extents))
    return {2: "xy", 1: "xz", 0: "yz"}[dropped]


@dataclass(frozen=True, slots=True)
class ShownEstimate:
    """An estimated path with its name and colour.

    ``errors_m`` (n,) are the position errors of its poses, None if they are not known. ``origin_s`` is the header
    timestamp from which pages count time.
    """

    name: str
    path: PathSeries
    colour: str
    errors_m: Array | None = None
    origin_s: float | None = None

    @property
    def beside(self) -> Figure:
        """Arrays that a trace of the path carries beside its positions, with a gap where the path has one."""
        if self.origin_s is None:
            return {}
        known = {"times_s": self.path.times_s - self.origin_s}
        known |= {} if self.errors_m is None else {"errors_m": self.errors_m}
        return {key: numbers(_broken(values[:, None], self.path.pieces)[:, 0]) for key, values in known.items()}


def shown_estimate(series: RunSeries, name: str, colour: str) -> ShownEstimate | None:
    """The estimate of a run as it is drawn; None without one."""
    if series.estimate is None:
        return None
    return ShownEstimate(name, series.estimate, colour, series.estimate_errors_m, series.start_s)


def run_figures(series: RunSeries, name: str, colour: str, *, in_space: bool = False) -> dict[str, Figure]:
    """All plots that the run has data for: ``path_xy``, ``path_xz``, ``path_yz``, ``error``, ``latency`` ...

    ``in_space`` draws the path once, as ``path``, instead of its planes.
    """
    figures: dict[str, Figure] = {}
    estimate = shown_estimate(series, name, colour)
    if estimate is not None or series.groundtruth is not None:
        draw = space_figures if in_space else plane_figures
        figures |= draw(series.groundtruth, estimate)
    figures |= curve_figures(series, name, colour)
    return _with_one_time_axis(figures, [series])


def curve_figures(series: RunSeries, name: str, colour: str) -> dict[str, Figure]:
    """The plots of a run over time that it has data for: ``error``, ``latency``, ``dropped``, ``cpu``, ``memory``."""
    figures: dict[str, Figure] = {}
    if series.error is not None:
        figures["error"] = _over_time(series.error, name, colour, _time_of(series.error), "position error [m]")
    if series.cpu is not None:
        figures["cpu"] = _over_time(series.cpu, name, colour, _time_of(series.cpu), "CPU in use [cores]")
    if series.memory is not None:
        in_mb = replace(series.memory, values=series.memory.values * 1e-6)
        figures["memory"] = _over_time(in_mb, name, colour, _time_of(in_mb), "memory in use [MB]")
    if series.latency is not None:
        in_ms = replace(series.latency, values=series.latency.values * 1e3)
        figure = _over_time(in_ms, name, colour, _time_of(in_ms), "latency per frame [ms]", dots=True)
        figures["latency"] = figure
        if len(series.dropped_s):
            # A cross at 0 for each dropped frame.
            crosses = _trace(
                series.dropped_s,
                np.zeros(len(series.dropped_s)),
                name="dropped",
                mode="markers",
                marker={"symbol": "x-thin", "size": 6, "line": {"width": 1.2}},
                meta=THEMED,
                hovertemplate="dropped at %{x:.2f} s<extra></extra>",
            )
            figures["latency"] = {**figure, "data": [*figure["data"], crosses]}
    if series.dropped_s is not None and len(series.dropped_s):
        # Steps: how many frames were dropped in each interval of the recording, most often of a second.
        last_s = max(float(series.dropped_s.max()), 0.0 if series.played_s is None else series.played_s[1])
        width_s = max(1.0, math.ceil(last_s / MOST_INTERVALS))
        edges_s = np.arange(0.0, last_s + 2 * width_s, width_s)
        counts = np.histogram(series.dropped_s, edges_s)[0].astype(np.float64)
        interval = "1 s" if width_s == 1 else f"{width_s:g} s"
        line = {"color": colour, "width": 1.5, "shape": "hv"}
        trace = _trace(
            edges_s[:-1],
            counts,
            name=name,
            mode="lines",
            line=line,
            fill="tozeroy",
            fillcolor=translucent(colour, 0.25),
        )
        layout = {
            "xaxis": {"title": {"text": _RECORDING_TIME}},
            "yaxis": {"title": {"text": f"frames dropped per {interval}"}, "rangemode": "tozero"},
            "showlegend": False,
        }
        figures["dropped"] = _figure([trace], layout)
    return figures


def _time_of(samples: Samples) -> str:
    return "time since the start of the run [s]" if samples.origin_s is None else _RECORDING_TIME


def _over_recording(series: RunSeries) -> dict[str, Samples]:
    """The data of the plots over the time of the recording."""
    plots = {"error": series.error, "latency": series.latency, "cpu": series.cpu, "memory": series.memory}
    return {key: samples for key, samples in plots.items() if samples is not None and samples.origin_s is not None}


def _with_one_time_axis(figures: dict[str, Figure], runs: Sequence[RunSeries]) -> dict[str, Figure]:
    """The same range for all plots over the time of the recording.

    Of a single run, it is grey where nothing was played.
    """
    known = [samples for series in runs for samples in _over_recording(series).values()]
    if not known:
        return figures
    low = min(float(samples.times_s.min()) for samples in known)
    high = max(float(samples.times_s.max()) for samples in known)
    played_s = runs[0].played_s if len(runs) == 1 else None
    shapes: list[Figure] = []
    if played_s is not None:
        first, last = played_s
        look = {"type": "rect", "layer": "below", "fillcolor": "rgba(128,128,128,0.15)", "line": {"width": 0}}
        height = {"xref": "x", "yref": "paper", "y0": 0, "y1": 1}
        idle = [(start, end) for start, end in ((low, first), (last, high)) if start < end]
        shapes = [{**look, **height, "x0": start, "x1": end} for start, end in idle]
    for figure in figures.values():
        if figure["layout"].get("xaxis", {}).get("title", {}).get("text") == _RECORDING_TIME:
            figure["layout"]["xaxis"]["range"] = [low, high]
            if shapes:
                figure["layout"]["shapes"] = shapes
    return figures


def timeline(series: RunSeries) -> dict[str, Any] | None:
    """The plots over the time of the recording, None without any.

    ``origin_s`` is the timestamp at which their time axis is 0, ``origins`` the same for each plot. ``from_s`` and
    ``until_s`` are the first and the last timestamp of all of them, ``worst_s`` is that of the largest error or None.
    """
    over_time = _over_recording(series)
    if not over_time:
        return None
    origins = {key: samples.origin_s or 0.0 for key, samples in over_time.items()}
    known = {key: samples for key, samples in over_time.items() if key in {"error", "latency"}} or over_time
    from_s = min(origins[key] + max(0.0, float(samples.times_s.min())) for key, samples in known.items())
    until_s = max(origins[key] + float(samples.times_s.max()) for key, samples in known.items())
    origin_s = next(iter(origins.values()))
    if len(series.dropped_s):
        origins["dropped"] = origin_s
    span = {"origin_s": origin_s, "from_s": from_s, "until_s": until_s}
    return {"origins": origins, **span, "worst_s": series.worst_s}


def plane_figures(groundtruth: PathSeries | None, estimate: ShownEstimate | None) -> dict[str, Figure]:
    """The path in its three planes, ground truth dashed, equal aspect, start and end marked.

    Args:
        groundtruth: The reference, None if there is none.
        estimate: None to show the ground truth alone.
    """
    return {f"path_{plane}": _plane_figure(plane, groundtruth, estimate) for plane in PLANES}


def space_figures(groundtruth: PathSeries | None, estimate: ShownEstimate | None) -> dict[str, Figure]:
    """The same path in 3D as ``path``, of which a static site makes the planes."""
    traces: list[Figure] = []
    hover = "x %{x:.4g} m<br>y %{y:.4g} m<br>z %{z:.4g} m"
    if estimate is not None:
        track, colour = estimate.path, estimate.colour
        parts = ((estimate.name, _broken, {"color": colour, "width": 5}), (_LOST, _bridges, _bridge_line(colour, 2)))
        for label, points_of, line in parts:
            points = points_of(track.positions_m, track.pieces)
            if len(points):
                x, y, z = points.T
                traces.append(_trace(x, y, z, name=label, mode="lines", line=line, hovertemplate=hover))
    if groundtruth is not None:
        x, y, z = _short(groundtruth.positions_m).T
        line = {"dash": "dash", "width": 3}
        traces.append(_trace(x, y, z, name="ground truth", mode="lines", line=line, meta=THEMED, hovertemplate=hover))

    track, end_colour = _marked(groundtruth, estimate)
    for label, symbol, point in (("start", "circle", track.positions_m[0]), ("end", "square", track.positions_m[-1])):
        x, y, z = ([float(value)] for value in point)
        marker = {"symbol": symbol, "size": 5} | ({"color": end_colour} if end_colour else {})
        meta = None if end_colour else THEMED
        traces.append(_trace(x, y, z, name=label, mode="markers", marker=marker, meta=meta))

    tracks = [entry for entry in (groundtruth, None if estimate is None else estimate.path) if entry is not None]
    # Equal-scale axes with a box that always fits the view. Plotly's own equal aspect clips long, flat paths.
    positions_m = np.concatenate([track.positions_m for track in tracks])
    low, high = positions_m.min(axis=0), positions_m.max(axis=0)
    longest_m = max(float((high - low).max()), 1e-3)
    half_m = np.maximum((high - low) * 0.525, 0.05 * longest_m)
    middle = (low + high) / 2
    scene: dict[str, Any] = {
        f"{axis}axis": {
            "title": {"text": f"{axis} [m]"},
            "range": [float(middle[place] - half_m[place]), float(middle[place] + half_m[place])],
            "nticks": 3 if half_m[place] < 0.2 * longest_m else 8,
        }
        for place, axis in enumerate(AXES)
    }
    ratio = {axis: float(1.5 * half_m[place] / half_m.max()) for place, axis in enumerate(AXES)}
    scene |= {"aspectmode": "manual", "aspectratio": ratio, "camera": {"eye": {"x": 1.1, "y": -1.3, "z": 0.9}}}
    return {"path": _figure(traces, {"scene": scene, "legend": _LEGEND})}


def motion_figures(motion: Motion, colour: str, *, positions_only: bool) -> dict[str, Figure]:
    """``speed`` and, unless ``positions_only``, ``angular_rate`` of a ground truth over time."""
    if len(motion.times_s) == 0:
        return {}
    curves = {"speed": (motion.speeds_mps, "speed [m/s]")}
    if not positions_only:
        curves["angular_rate"] = (motion.angular_rates_radps, "angular rate [rad/s]")
    times_s = motion.times_s - motion.times_s[0]
    return {
        name: _over_time(samples_of(times_s, values), name, colour, "time since the first pose [s]", title)
        for name, (values, title) in curves.items()
    }


def residuals_figure(trial: TruthTrialDocument) -> Figure:
    """The distance of each system from the ground truth over time, what they have in common, and the stretches."""
    times_s = np.array(trial.times_s)
    curves = {**trial.residuals_m, "in common": trial.common_m}
    traces = [
        _trace(
            times_s,
            np.array(values, dtype=np.float64),
            name=name,
            mode="lines",
            hovertemplate="%{y:.3g} m at %{x:.1f} s",
        )
        for name, values in curves.items()
    ]
    traces[-1] |= {"line": {"width": 2.5}, "meta": THEMED}
    shapes = [
        {
            "type": "rect",
            "xref": "x",
            "yref": "paper",
            "x0": entry.begin_s - trial.start_s,
            "x1": entry.end_s - trial.start_s,
            "y0": 0,
            "y1": 1,
            "fillcolor": "#D55E00",
            "opacity": 0.25,
            "line": {"width": 0},
        }
        for entry in trial.stretches
    ]
    layout = {
        "xaxis": {"title": {"text": "time since the first pose [s]"}},
        "yaxis": {"title": {"text": "distance [m]"}, "rangemode": "tozero"},
        "showlegend": True,
        "shapes": shapes,
    }
    return _figure(traces, layout)


SWEEP_POINTS = 6_000
"""A sweep on a page has no more points: more of them weigh as much as the page and look the same."""


def sweep_json(sweep: SweepView, sensor: str) -> dict[str, Any]:
    """The points of a LiDAR sweep, x, y, z of one after the other in m, and a caption."""
    kept = np.linspace(0, len(sweep.positions_m) - 1, min(len(sweep.positions_m), SWEEP_POINTS)).astype(np.int64)
    shown = "" if sweep.points == len(kept) else f", {thousands(len(kept))} of them shown"
    return {
        "points_m": numbers(sweep.positions_m[kept].reshape(-1)),
        "caption": f"{sensor} at {sweep.time_s:.3f} s: {plural(sweep.points, 'point')}{shown}, in the sensor's frame.",
    }


@dataclass(frozen=True, slots=True)
class ComparedRun:
    """A run as a comparison draws it. All runs of a comparison count time from the same timestamp."""

    run_id: int
    name: str
    colour: str
    series: RunSeries


COMPARED_POINTS = 12_000
"""The paths of a comparison have no more poses together, so that twenty runs weigh no more than a few."""


def compared_figures(runs: Sequence[ComparedRun]) -> dict[str, Figure]:
    """The plots of several runs on common axes, each trace with the number of its ``run``.

    A path is drawn if it was aligned to the ground truth, since others lie in frames of their own. Of CPU and memory,
    what counts from the start of a run is left out beside what counts from that of the recording.
    """
    figures: dict[str, Figure] = {}
    most = max(200, COMPARED_POINTS // max(1, len(runs)))
    for shown in runs:
        series = shown.series
        own = curve_figures(series, shown.name, shown.colour)
        if series.estimate is not None and series.aligned:
            path = series.estimate.thinned(most)
            estimate = ShownEstimate(shown.name, path, shown.colour, None, series.start_s)
            own |= {f"path_{plane}": _plane_figure(plane, None, estimate) for plane in PLANES}
        for key, figure in own.items():
            known = figures.setdefault(key, {"data": [], "layout": figure["layout"]})
            if known["layout"]["xaxis"]["title"] == figure["layout"]["xaxis"]["title"]:
                known["data"] += [_of_run(shown, trace) for trace in figure["data"] if trace.get("name") not in _ENDS]
    truth = next((shown.series.groundtruth for shown in runs if shown.series.groundtruth is not None), None)
    if truth is not None:
        points = _short(truth.thinned(most).positions_m)
        for plane in PLANES:
            if f"path_{plane}" in figures:
                figures[f"path_{plane}"]["data"].append(_truth_line(plane, points))
    one_axis = _with_one_time_axis(figures, [shown.series for shown in runs])
    return {key: with_dark_colours(figure) for key, figure in one_axis.items()}


def _of_run(shown: ComparedRun, trace: Figure) -> Figure:
    """A trace that says of which run it is; crosses of dropped frames get its colour."""
    found = {**trace, "run": shown.run_id}
    if found.get("meta") == THEMED:
        del found["meta"]
        found["marker"] = {**found["marker"], "color": shown.colour}
    return found


def captions(series: RunSeries, protocol: str | None) -> dict[str, str]:
    """The caption of each plot: number of points and how they were processed."""
    texts: dict[str, str] = {}
    if series.estimate is not None:
        how = f"aligned with {protocol}" if series.aligned else "in its own frame, not aligned to any ground truth"
        texts["path"] = (
            f"{plural(series.estimate.poses, 'matched pose' if series.aligned else 'pose')} of the estimate, {how}."
        )
        if series.estimate.pieces[-1]:
            gaps = plural(int(series.estimate.pieces[-1]), "gap")
            texts["path"] += f" Dotted: {gaps} of more than {significant(series.gap_s)} s without a pose."
    if series.groundtruth is not None:
        texts["path"] = texts.get("path", "") + f" Ground truth dashed, {plural(series.groundtruth.poses, 'pose')}."
    if series.error is not None:
        texts["error"] = (
            f"Distance from estimate to ground truth at n = {plural(series.error.count, 'matched pose')}; {protocol}."
        )
    if series.cpu is not None:
        idle = "" if series.played_s is None else " Grey: no frame is played yet, or none any more."
        texts["cpu"] = f"n = {plural(series.cpu.count, 'sample')}, cores summed, player included.{idle}"
        texts["memory"] = f"n = {plural(series.cpu.count, 'sample')}, player included.{idle}"
    if len(series.dropped_s):
        texts["dropped"] = f"{plural(len(series.dropped_s), 'frame')} that the algorithm was too slow to take."
    if series.latency is not None:
        texts["latency"] = (
            f"From arrival to result, n = {plural(series.latency.count, 'frame')}; dropped frames have none"
            f"{' and are crosses at 0' if len(series.dropped_s) else ''}."
        )
    return texts


PLOTS_WITH_DATA = ("path", "error", "cpu", "memory", "latency")
"""The plots of a run whose data can be had."""


def figure_csv(series: RunSeries, figure: str) -> str:
    """The data of a plot as CSV; raises NotFound if there is none."""
    table = figure_table(series, figure)
    if table is None:
        raise NotFound(f"this run has no data for the plot {figure[:40]!r}", f"use {', '.join(PLOTS_WITH_DATA)}")
    header, lines = table
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(lines)
    return text.getvalue()


def figure_table(series: RunSeries, figure: str) -> tuple[list[str], list[Sequence[float | str]]] | None:
    """The data of a plot as a header and rows; None if there is none."""
    if figure == "path":
        rows: list[Sequence[float | str]] = []
        for name, track in (("groundtruth", series.groundtruth), ("estimate", series.estimate)):
            if track is not None:
                poses = zip(track.times_s, track.positions_m, strict=True)
                rows += [(name, float(at), *map(float, position)) for at, position in poses]
        return (["trajectory", "timestamp_s", "x_m", "y_m", "z_m"], rows) if rows else None
    samples, unit = {
        "error": (series.error, "error_m"),
        "cpu": (series.cpu, "cpu_cores"),
        "memory": (series.memory, "memory_bytes"),
        "latency": (series.latency, "latency_s"),
    }.get(figure, (None, ""))
    if samples is None:
        return None
    pairs: list[Sequence[float | str]] = list(zip(samples.times_s.tolist(), samples.values.tolist(), strict=True))
    return ["time_s", unit], pairs


def _plane_figure(plane: str, groundtruth: PathSeries | None, estimate: ShownEstimate | None) -> Figure:
    first, second = PLANES[plane]
    traces: list[Figure] = []
    if estimate is not None:
        track, colour = estimate.path, estimate.colour
        line = {"color": colour, "width": 2.5}
        points = _broken(track.positions_m, track.pieces)
        traces.append(_plane_line(plane, points, name=estimate.name, line=line, **estimate.beside))
        bridges = _bridges(track.positions_m, track.pieces)
        if len(bridges):
            traces.append(_plane_line(plane, bridges, name=_LOST, line=_bridge_line(colour, 1.2)))
    if groundtruth is not None:
        traces.append(_truth_line(plane, _short(groundtruth.positions_m)))

    # A circle where the estimate starts, and a square where it ends; those of the ground truth without an estimate.
    track, end_colour = _marked(groundtruth, estimate)
    ends = (("start", "circle-open", 13, track.positions_m[0]), ("end", "square", 7, track.positions_m[-1]))
    traces += [
        _trace(
            [float(point[first])],
            [float(point[second])],
            name=label,
            mode="markers",
            marker={"symbol": symbol, "size": size, "line": {"width": 2}}
            | ({"color": end_colour} if end_colour else {}),
            meta=None if end_colour else THEMED,
            hovertemplate=f"{label}<br>{_plane_hover(plane)}",
        )
        for label, symbol, size, point in ends
    ]
    layout = {
        "xaxis": {"title": {"text": f"{AXES[first]} [m]"}, "constrain": "domain"},
        "yaxis": {"title": {"text": f"{AXES[second]} [m]"}, "constrain": "domain", "scaleanchor": "x"},
        "legend": _LEGEND,
    }
    return _figure(traces, layout)


def _plane_line(plane: str, points: np.ndarray[Any, Any], **look: Any) -> Figure:
    first, second = PLANES[plane]
    x, y = points[:, first], points[:, second]
    return _trace(x, y, mode="lines", hovertemplate=_plane_hover(plane), **look)


def _truth_line(plane: str, points: np.ndarray[Any, Any]) -> Figure:
    return _plane_line(plane, points, name="ground truth", line={"dash": "dash", "width": 1.2}, meta=THEMED)


def _marked(groundtruth: PathSeries | None, estimate: ShownEstimate | None) -> tuple[PathSeries, str | None]:
    if estimate is not None:
        return estimate.path, estimate.colour
    if groundtruth is None:
        raise ValueError("a plot of a path needs a path")
    return groundtruth, None


def _over_time(samples: Samples, name: str, colour: str, x_title: str, y_title: str, *, dots: bool = False) -> Figure:
    look: dict[str, Any] = {"mode": "lines", "line": {"color": colour, "width": 1.5}}
    if dots:
        look = {"mode": "markers", "marker": {"color": colour, "size": 4}}
    points = np.column_stack([samples.times_s, samples.values])
    hover = "%{y:.4g} at %{x:.2f} s<extra></extra>"
    x, y = _broken(points, samples.pieces).T
    traces = [_trace(x, y, name=name, hovertemplate=hover, **look)]
    bridges = _bridges(points, samples.pieces)
    if len(bridges):
        x, y = bridges.T
        line = _bridge_line(colour, 1)
        traces.append(_trace(x, y, name=_LOST, mode="lines", line=line, hoverinfo="skip"))
    layout = {
        "xaxis": {"title": {"text": x_title}},
        "yaxis": {"title": {"text": y_title}, "rangemode": "tozero"},
        "showlegend": False,
    }
    return _figure(traces, layout)


_ENDS = ("start", "end")
"""Names of the markers of a path."""
_LOST = "tracking lost"
"""Label of the dotted lines between the pieces of an estimate."""


def _bridge_line(colour: str, width: float) -> dict[str, Any]:
    return {"color": colour, "width": width, "dash": "dot"}


def _broken(points: Array, pieces: Places) -> np.ndarray[Any, Any]:
    """The points (n, k) with a row of NaN, which breaks the line, before each new piece."""
    return np.insert(_short(points), np.flatnonzero(np.diff(pieces)) + 1, np.nan, axis=0)


def _bridges(points: Array, pieces: Places) -> np.ndarray[Any, Any]:
    """Straight lines across the gaps: last point of a piece, first point of the next, NaN, and so on."""
    last = np.flatnonzero(np.diff(pieces))
    nothing = np.full((len(last), points.shape[1]), np.nan)
    return _short(np.stack([points[last], points[last + 1], nothing], axis=1).reshape(-1, points.shape[1]))


_LEGEND = {"orientation": "h", "yanchor": "bottom", "y": 1.0, "xanchor": "left", "x": 0.0}


def _plane_hover(plane: str) -> str:
    first, second = PLANES[plane]
    return f"{AXES[first]} %{{x:.4g}} m<br>{AXES[second]} %{{y:.4g}} m"


def _short(values: Array) -> np.ndarray[Any, Any]:
    """Single precision is enough for a screen and halves the transfer."""
    return values.astype(np.float32)


def _trace(x: Values, y: Values, z: Values | None = None, **look: Any) -> Figure:
    """A trace of Plotly, in 3D with ``z``. Its own library of objects would take ten times as long to say the same."""
    places = {"x": x, "y": y} if z is None else {"x": x, "y": y, "z": z}
    packed = {axis: numbers(values) if isinstance(values, np.ndarray) else values for axis, values in places.items()}
    given = {name: value for name, value in look.items() if value is not None}
    return {"type": "scatter" if z is None else "scatter3d", **packed, **given}


def _figure(traces: list[Figure], layout: dict[str, Any]) -> Figure:
    return with_dark_colours({"data": traces, "layout": layout})
