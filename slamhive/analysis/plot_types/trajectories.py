"""Trajectories of many runs on one dataset, against the ground truth: paths, and position errors over time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field

from slamhive.analysis.chart import REFERENCE, Array, Axis, Chart, Line, Points
from slamhive.analysis.colours import PALETTE
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.places import legend
from slamhive.analysis.result import Exclusion, PlotResult, ResultTable, TableColumn
from slamhive.analysis.table import RunTable
from slamhive.errors import InvalidInput

_PLANES = {"xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
_AXES = "xyz"


class TrajectoriesOptions(base.PlotOptions):
    """The number of runs to draw."""

    most_runs: int = Field(
        default=40, ge=1, le=200, description="The first runs are drawn; more lines would be unreadable."
    )


class Trajectories(base.PlotType[TrajectoriesOptions]):
    """The plot type ``trajectories``."""

    key = "trajectories"
    title = "Trajectories"
    description = "The aligned trajectories of many runs on one dataset with the ground truth, and their errors."
    options = TrajectoriesOptions
    reads = frozenset({"ate.rmse", "tracked_fraction"})

    def build(self, data: base.PlotData, options: TrajectoriesOptions) -> PlotResult:
        """The path in its widest plane, coordinates and errors over time, a table of errors, the poses."""
        table = data.table.require_runs()
        dataset = base.one_value(table, "dataset", "a comparison of trajectories")
        protocol = table.one_protocol(["ate.rmse"])
        tracks, without = _tracks(data, options.most_runs)
        if not tracks:
            raise InvalidInput("no selected run has the files of an evaluated trajectory", "evaluate again, with files")
        truths = _ground_truths(tracks, table)
        text = base.caption(table, len(tracks), protocol, *_notes(dataset, tracks, truths))
        plane = _widest_plane(tracks[0].reference_positions_m)
        start_s = min(float(truth.timestamps_s[0]) for truth in truths)
        looks = _looks(tracks, table)
        key = [] if looks[tracks[0].run_id]["in_legend"] else list(legend(table, markers=False))
        drawn = _Drawn(tracks, looks, truths, start_s, text)
        charts = [_path(drawn, plane, options.title or f"Trajectories on {dataset}")]
        charts += [_coordinate(drawn, axis) for axis in range(3)]
        evaluated = [track for track in tracks if np.isfinite(track.errors_m).any()]
        errors = [_over_time(track, track.errors_m, looks[track.run_id], start_s) for track in evaluated]
        if errors:
            spread = base.spans_decades(np.concatenate([line.y for line in errors]))
            y = Axis("position error", "m", spread)
            time = Axis("time since the start of the ground truth", "s")
            charts.append(Chart("trajectory_error", "Position error", time, y, tuple(errors), text))
        charts = [replace(chart, marks=(*chart.marks, *key)) for chart in charts]
        tables = (base.raw_table("trajectories", table, ["ate.rmse", "tracked_fraction"], "Errors"), _poses(tracks))
        return base.result_of(table, protocol, charts, tables, excluded=without)


@dataclass(frozen=True, slots=True)
class _GroundTruth:
    """The ground truth in the frame of some runs' sensor: timestamps (n,) in s, positions (n, 3) in m."""

    name: str
    timestamps_s: Array
    positions_m: Array


@dataclass(frozen=True, slots=True)
class _Drawn:
    """Shared by the plots."""

    tracks: list[base.RunTrack]
    looks: dict[int, dict[str, Any]]
    truths: list[_GroundTruth]
    start_s: float
    text: str


def _ground_truths(tracks: list[base.RunTrack], table: RunTable) -> list[_GroundTruth]:
    """The distinct ground truths: runs have different ones if their estimates follow different sensors."""
    algorithms = dict(zip(table.frame["run_id"], table.frame["algorithm"], strict=True))
    found: list[tuple[base.RunTrack, set[str]]] = []
    for track in tracks:
        known = next((names for first, names in found if _same_ground_truth(first, track)), None)
        if known is None:
            known = set()
            found.append((track, known))
        known.add(str(algorithms[track.run_id]))
    alone = len(found) == 1
    return [
        _GroundTruth(
            "ground truth" if alone else f"ground truth for {', '.join(sorted(names))}",
            track.reference_stamps_s,
            track.reference_positions_m,
        )
        for track, names in found
    ]


def _same_ground_truth(first: base.RunTrack, second: base.RunTrack) -> bool:
    """Whether two ground truths are equal to a tenth of a millimetre at every timestamp."""
    one, other = first.reference_positions_m, second.reference_positions_m
    return (
        one.shape == other.shape
        and np.allclose(first.reference_stamps_s, second.reference_stamps_s, rtol=0, atol=1e-6)
        and np.allclose(one, other, rtol=0, atol=1e-4)
    )


def _notes(dataset: str, tracks: list[base.RunTrack], truths: list[_GroundTruth]) -> Iterator[str]:
    yield f"Ground truth of {dataset} dashed; circles: start."
    if len(truths) > 1:
        yield (
            f"The estimates follow {len(truths)} different sensors, so the ground truth is drawn {len(truths)} times, "
            "once in the frame of each sensor."
        )
    if any(track.pieces[-1] for track in tracks):
        yield "Lines break where the estimate has a longer gap than the protocol allows."


def _tracks(data: base.PlotData, most: int) -> tuple[list[base.RunTrack], list[Exclusion]]:
    runs = [int(run) for run in data.table.good()["run_id"]]
    tracks: list[base.RunTrack] = []
    lacking: list[int] = []
    for place, run in enumerate(runs):
        if len(tracks) == most:
            break
        data.progress(place / len(runs))
        track = data.files.track(run)
        lacking += [] if track is not None else [run]
        tracks += [] if track is None else [track]
    left_over = runs[len(tracks) + len(lacking) :]
    return tracks, [
        Exclusion("no files of an evaluation", tuple(lacking)),
        Exclusion("more runs than are drawn", tuple(left_over)),
    ]


def _looks(tracks: list[base.RunTrack], table: RunTable) -> dict[int, dict[str, Any]]:
    """{run: look}: coloured by algorithm, or by run if there are only a few runs of one algorithm."""
    algorithms = dict(zip(table.frame["run_id"], table.frame["algorithm"], strict=True))
    single = len(set(algorithms.values())) == 1 and len(tracks) <= len(PALETTE)
    return {
        track.run_id: {
            "name": f"run {track.run_id}, {algorithms[track.run_id]}",
            "colour": PALETTE[place] if single else table.colours[algorithms[track.run_id]],
            "in_legend": single,
            "group": f"run {track.run_id}" if single else algorithms[track.run_id],
        }
        for place, track in enumerate(tracks)
    }


def _widest_plane(positions_m: Array) -> str:
    dropped = int(np.argmin(np.ptp(positions_m, axis=0)))
    return {2: "xy", 1: "xz", 0: "yz"}[dropped]


def _path(drawn: _Drawn, plane: str, title: str) -> Chart:
    first, second = _PLANES[plane]
    marks: list[Line | Points] = []
    for track in drawn.tracks:
        look = drawn.looks[track.run_id]
        x, y = track.positions_m[:, first], track.positions_m[:, second]
        marks.append(Line(x=_apart(track, x), y=_apart(track, y), runs=track.run_id, **look))
        marks.append(Points(x=x[:1], y=y[:1], **look | {"in_legend": False}))
    for truth in drawn.truths:
        x, y = truth.positions_m[:, first], truth.positions_m[:, second]
        marks.append(Line(truth.name, x, y, colour=REFERENCE, dashed=True))
    return Chart(
        key=f"trajectories_{plane}",
        title=title,
        x=Axis(_AXES[first], "m"),
        y=Axis(_AXES[second], "m"),
        marks=tuple(marks),
        caption=drawn.text,
        equal_aspect=True,
        height=1.3,
    )


def _apart(track: base.RunTrack, values: Array) -> Array:
    """The values of a track with NaN between its pieces, so that no line joins them."""
    return np.insert(values, np.flatnonzero(np.diff(track.pieces)) + 1, np.nan)


def _coordinate(drawn: _Drawn, axis: int) -> Chart:
    start_s = drawn.start_s
    lines = [
        _over_time(track, track.positions_m[:, axis], drawn.looks[track.run_id], start_s) for track in drawn.tracks
    ]
    for truth in drawn.truths:
        times_s, values = truth.timestamps_s - start_s, truth.positions_m[:, axis]
        lines.append(Line(truth.name, times_s, values, colour=REFERENCE, dashed=True))
    return Chart(
        key=f"trajectories_{_AXES[axis]}",
        title=f"{_AXES[axis]} over time",
        x=Axis("time since the start of the ground truth", "s"),
        y=Axis(_AXES[axis], "m"),
        marks=tuple(lines),
        caption=drawn.text,
        height=0.7,
    )


def _over_time(track: base.RunTrack, values: Array, look: dict[str, Any], start_s: float) -> Line:
    return Line(x=_apart(track, track.stamps_s - start_s), y=_apart(track, values), runs=track.run_id, **look)


def _poses(tracks: list[base.RunTrack]) -> ResultTable:
    columns = (
        TableColumn("run_id", "Run", links_run=True),
        TableColumn("timestamp_s", "Timestamp", "s"),
        *(TableColumn(f"{axis}_m", axis, "m") for axis in _AXES),
        TableColumn("error_m", "Position error", "m"),
    )
    rows = tuple(
        (track.run_id, float(at), *map(float, position), float(error) if np.isfinite(error) else None)
        for track in tracks
        for at, position, error in zip(track.stamps_s, track.positions_m, track.errors_m, strict=True)
    )
    return ResultTable("poses", "Poses", columns, rows, raw=True)
