"""Trajectories of many runs on one dataset, against the ground truth: paths, and position errors over time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field

from slamhive.analysis.chart import PALETTE, REFERENCE, Array, Axis, Chart, Line, Points
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import (
    FOLDED,
    RECORDING_TIME,
    Curve,
    LineOptions,
    Looks,
    legend_of,
    lines_of,
    looks_of,
    read_runs,
    recording_starts,
)
from slamhive.analysis.report import PlotResult, ResultTable, TableColumn
from slamhive.analysis.table import RunTable
from slamhive.base.errors import InvalidInput

_PLANES = {"xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
_AXES = "xyz"
_TRUTH_COLOURS = (REFERENCE, "#8f8f8f", "#b08d57")
"""Of the ground truth in the frames of up to three sensors; further ones look like the third."""
_SINCE_GROUND_TRUTH = Axis("time since the start of the ground truth", "s")


class TrajectoriesOptions(LineOptions):
    """The runs to draw, and how."""

    most_runs: int = Field(
        default=40, ge=1, le=200, description="The first runs are drawn; more lines would be unreadable."
    )
    with_failed: bool = Field(default=False, description="Also draw runs that count as failed, dashed.")
    in_3d: bool = Field(default=False, description="Also draw the trajectories in three dimensions.")


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
        rows = table.frame if options.with_failed else table.good()
        tracks, excluded = read_runs(
            data, rows["run_id"], data.files.track, options.most_runs, "no files of an evaluation"
        )
        if not tracks:
            raise InvalidInput("no selected run has the files of an evaluated trajectory", "evaluate again, with files")
        by = options.coloured_by or (
            "run" if table.frame["algorithm"].nunique() == 1 and len(tracks) <= len(PALETTE) else "algorithm"
        )
        truths = _ground_truths(tracks, table)
        text = base.caption(table, len(tracks), protocol, *_notes(dataset, tracks, truths))
        time, start_s = _time_axis(truths, recording_starts(data))
        drawn = _Drawn(tracks, looks_of(table, by, options.colour_order), truths, time, start_s, text)
        charts = [
            _path(drawn, _widest_plane(tracks[0].reference_positions_m), options.title or f"Trajectories on {dataset}")
        ]
        charts += [_space(drawn)] if options.in_3d else []
        charts += [_coordinate(drawn, axis) for axis in range(3)]
        charts += _errors(drawn, table, folded=options.folded)
        key = tuple(legend_of(table, by))
        charts = [replace(chart, marks=(*chart.marks, *key)) for chart in charts]
        tables = (base.raw_table("trajectories", table, ["ate.rmse", "tracked_fraction"], "Errors"), _poses(tracks))
        return base.result_of(table, protocol, charts, tables, excluded=excluded)


@dataclass(frozen=True, slots=True)
class _GroundTruth:
    """The ground truth in the frame of some runs' sensor: timestamps (n,) in s, positions (n, 3) in m."""

    name: str
    colour: str
    timestamps_s: Array
    positions_m: Array


@dataclass(frozen=True, slots=True)
class _Drawn:
    """Shared by the plots."""

    tracks: list[base.RunTrack]
    looks: Looks
    truths: list[_GroundTruth]
    time: Axis
    start_s: float
    text: str


def _time_axis(truths: Sequence[_GroundTruth], starts_s: Mapping[int, float]) -> tuple[Axis, float]:
    """The axis over time and the timestamp of its zero. Imported runs alone do not say when the recording starts."""
    if starts_s:
        return RECORDING_TIME, min(starts_s.values())
    return _SINCE_GROUND_TRUTH, min(float(truth.timestamps_s[0]) for truth in truths)


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
            _TRUTH_COLOURS[min(place, len(_TRUTH_COLOURS) - 1)],
            track.reference_stamps_s,
            track.reference_positions_m,
        )
        for place, (track, names) in enumerate(found)
    ]


def _same_ground_truth(first: base.RunTrack, second: base.RunTrack) -> bool:
    """Tell if two ground truths are equal to a tenth of a millimetre at every timestamp."""
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
        marks.append(Points(x=x[:1], y=y[:1], **_start(look)))
    for truth in drawn.truths:
        x, y = truth.positions_m[:, first], truth.positions_m[:, second]
        marks.append(Line(truth.name, x, y, colour=truth.colour, dashed=True))
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


def _start(look: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in look.items() if key != "dashed"} | {"in_legend": False}


def _space(drawn: _Drawn) -> Chart:
    """The paths in three dimensions."""
    marks: list[Line | Points] = []
    for track in drawn.tracks:
        look = drawn.looks[track.run_id]
        x, y, z = (_apart(track, values) for values in track.positions_m.T)
        marks.append(Line(x=x, y=y, z=z, runs=track.run_id, **look))
        marks.append(Points(x=x[:1], y=y[:1], z=z[:1], **_start(look)))
    for truth in drawn.truths:
        x, y, z = truth.positions_m.T
        marks.append(Line(truth.name, x, y, z=z, colour=truth.colour, dashed=True))
    return Chart(
        key="trajectories_3d",
        title="In three dimensions",
        x=Axis("x", "m"),
        y=Axis("y", "m"),
        z=Axis("z", "m"),
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
        Line(x=curve.times_s, y=curve.values, runs=curve.run_id, **drawn.looks[curve.run_id])
        for curve in (_curve(track, track.positions_m[:, axis], start_s) for track in drawn.tracks)
    ]
    for truth in drawn.truths:
        times_s, values = truth.timestamps_s - start_s, truth.positions_m[:, axis]
        lines.append(Line(truth.name, times_s, values, colour=truth.colour, dashed=True))
    return Chart(
        key=f"trajectories_{_AXES[axis]}",
        title=f"{_AXES[axis]} over time",
        x=drawn.time,
        y=Axis(_AXES[axis], "m"),
        marks=tuple(lines),
        caption=drawn.text,
        height=0.7,
    )


def _errors(drawn: _Drawn, table: RunTable, *, folded: bool) -> list[Chart]:
    """The errors over time; none for runs that were evaluated without a trajectory of the ground truth."""
    evaluated = [track for track in drawn.tracks if np.isfinite(track.errors_m).any()]
    if not evaluated:
        return []
    curves = [_curve(track, track.errors_m, drawn.start_s) for track in evaluated]
    lines = tuple(lines_of(curves, table, drawn.looks, folded=folded))
    y = Axis("position error", "m", base.spans_decades(np.concatenate([line.y for line in lines])))
    text = f"{drawn.text} {FOLDED}" if folded else drawn.text
    return [Chart("trajectory_error", "Position error", drawn.time, y, lines, text)]


def _curve(track: base.RunTrack, values: Array, start_s: float) -> Curve:
    return Curve(track.run_id, _apart(track, track.stamps_s - start_s), _apart(track, values))


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
