"""Looks of runs that are drawn as one line each: colour, name and legend; and repeats folded into mean and band."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import REFERENCE, RUN_COLOURS, Array, Axis, FailedRuns, Line, Points
from slamhive.analysis.plot_types import base
from slamhive.analysis.report import Exclusion
from slamhive.analysis.table import FAILED, RunTable, is_disturbed

# Positions of values on an axis, and marks that several plot types share.


_NOWHERE = np.zeros(0)


def places_on(axis: Axis, values: pd.Series) -> Array:
    """Values as numbers; for categories, their positions (NaN where there is none)."""
    if axis.categories is None:
        return np.asarray(values, dtype=float)
    position = {name: float(place) for place, name in enumerate(axis.categories)}
    return np.array([position.get(str(value), np.nan) for value in values], dtype=float)


def failed_marks(table: RunTable, axis: Axis, key: str) -> Iterator[FailedRuns]:
    """Failed runs by algorithm, at their value on the x axis. They have parameters, but no metrics."""
    for algorithm, rows in table.failed().groupby("algorithm", sort=True):
        yield FailedRuns(
            x=places_on(axis, rows[key]),
            runs=rows["run_id"].to_numpy(dtype=int),
            colour=table.colours[str(algorithm)],
            name=f"{algorithm}, failed",
            group=str(algorithm),
        )


def disturbed_rings(shown: pd.DataFrame, x: Array, y: Array, z: Array | None = None) -> Iterator[Points]:
    """A ring around each run that was measured on a disturbed machine; hovering shows the disturbance.

    Args:
        shown: The rows behind the points.
        x, y, z: Positions of the points.
    """
    chosen = is_disturbed(shown).to_numpy(dtype=bool)
    if chosen.any():
        yield Points(
            "disturbed machine",
            x[chosen],
            y[chosen],
            z=None if z is None else z[chosen],
            colour=REFERENCE,
            runs=shown["run_id"].to_numpy(dtype=int)[chosen],
            texts=tuple(f"disturbed by {words}" for words in shown["disturbed"][chosen]),
            ring=True,
        )


def look_of(table: RunTable, algorithm: str, dataset: str) -> dict[str, Any]:
    """The look of one algorithm on one dataset; :func:`legend` explains it."""
    return {
        "name": f"{algorithm} on {dataset}",
        "colour": table.colours[algorithm],
        "in_legend": False,
        "group": algorithm,
    }


def legend(table: RunTable, *, markers: bool = True) -> Iterator[Points]:
    """Legend entries for the colours of algorithms and, if there are several, the markers of datasets.

    Args:
        table: The runs of the plot.
        markers: Whether the plot has markers.
    """
    algorithms = sorted(table.frame["algorithm"].unique())
    datasets = sorted(table.frame["dataset"].unique())
    shapes = {table.markers[name] for name in datasets} if markers else set()
    told_apart = len(shapes) > 1
    for name in algorithms:
        yield Points(name, _NOWHERE, _NOWHERE, colour=table.colours[name], marker=table.marker(name), group=name)
    for name in datasets if told_apart else ():
        yield Points(f"on {name}", _NOWHERE, _NOWHERE, colour=REFERENCE, marker=table.markers[name])


def settings_words(table: RunTable) -> pd.Series:
    """The settings of each run in words: the parameters that vary in the selection."""
    varied = [column.key for column in table.varied()]

    def words(row: pd.Series) -> str:
        return ", ".join(f"{key} {value_words(row[key])}" for key in varied if not pd.isna(row[key])) or "as given"

    groups = table.frame.groupby(["configuration_id", *table.varied_limits], sort=False, dropna=False).ngroup()
    unique = table.frame[varied].assign(group=groups).drop_duplicates("group")
    named = dict(zip(unique["group"], unique.apply(words, axis=1), strict=True)) if len(unique) else {}
    return groups.map(named)


def value_words(value: object) -> str:
    """A value as axes and tables show it: 20 instead of 20.0."""
    return f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)


By = Literal["algorithm", "run", "configuration"]
Looks = Mapping[int, dict[str, Any]]
ReadT = TypeVar("ReadT")
_GRID_POINTS = 600
"""Points of a folded line; a screen has few more columns."""

FOLDED = "Line: mean of the repeats of a configuration; band: from the smallest to the largest."


class LineOptions(base.PlotOptions):
    """Options of plot types that draw a line for each run."""

    most_runs: int = Field(
        default=60, ge=1, le=500, description="The first runs are drawn; more lines would be unreadable."
    )
    coloured_by: By | None = Field(
        default=None, description="What a colour means: an algorithm, a run or a configuration. Default: what fits."
    )
    colour_order: list[int] = Field(
        default_factory=list,
        max_length=500,
        description="Numbers of the runs or configurations in the order of their colours. Default: ascending.",
    )
    folded: bool = Field(
        default=False, description="Repeats of a configuration become their mean over time, with a band."
    )


@dataclass(frozen=True, slots=True)
class Curve:
    """The values of one run over time (s); NaN breaks the line."""

    run_id: int
    times_s: Array
    values: Array


def read_runs(
    data: base.PlotData, runs: Iterable[int], read: Callable[[int], ReadT | None], most: int, lacking: str
) -> tuple[list[ReadT], tuple[Exclusion, Exclusion]]:
    """Read the files of the first ``most`` runs that have them, and tell the progress.

    Args:
        data: Reports the progress.
        runs: The runs to draw, in order.
        read: Reads one run; None if the run lacks the files.
        most: How many runs are drawn.
        lacking: The reason to state for runs without the files.

    Returns:
        What was read, and the runs that are left out: those without the files, and those after the first ``most``.
    """
    wanted = [int(run) for run in runs]
    found: list[ReadT] = []
    without: list[int] = []
    for place, run in enumerate(wanted):
        if len(found) == most:
            break
        data.progress(place / len(wanted))
        content = read(run)
        if content is None:
            without.append(run)
        else:
            found.append(content)
    left_over = wanted[len(found) + len(without) :]
    return found, (Exclusion(lacking, tuple(without)), Exclusion("more runs than are drawn", tuple(left_over)))


def looks_of(table: RunTable, by: By, order: Sequence[int] = ()) -> Looks:
    """{run: the look of its line}; ``order`` keeps colours where some plots lack some of the runs."""
    failed = set(table.failed()["run_id"])
    facts = table.frame[["run_id", "configuration_id", "algorithm"]].itertuples(index=False, name=None)
    colours: dict[Any, str] = {key: _colour(place) for place, key in enumerate(dict.fromkeys(order))}
    named: set[Any] = set()
    looks: dict[int, dict[str, Any]] = {}
    for run, configuration, algorithm in facts:
        key = {"run": run, "configuration": configuration, "algorithm": algorithm}[by]
        first = key not in named
        named.add(key)
        colours.setdefault(key, _colour(len(colours)))
        group = algorithm if by == "algorithm" else f"{by} {key}, {algorithm}"
        looks[int(run)] = {
            "name": group if by == "configuration" else f"run {run}, {algorithm}",
            "colour": table.colours[algorithm] if by == "algorithm" else colours[key],
            "dashed": run in failed,
            "in_legend": first and by != "algorithm",
            "group": group,
        }
    return looks


def _colour(place: int) -> str:
    return RUN_COLOURS[place % len(RUN_COLOURS)]


def legend_of(table: RunTable, by: By) -> Iterator[Points]:
    """Entries for the colours of algorithms; lines of runs and configurations are entries themselves."""
    if by == "algorithm":
        yield from legend(table, markers=False)


def lines_of(curves: Sequence[Curve], table: RunTable, looks: Looks, *, folded: bool) -> Iterator[Line]:
    """A line for each curve; if ``folded``, one for each configuration. Failed runs keep a line of their own."""
    if not folded:
        for curve in curves:
            yield Line(x=curve.times_s, y=curve.values, runs=curve.run_id, **looks[curve.run_id])
        return
    groups = _repeats(curves, table)
    for members in groups:
        look = looks[members[0].run_id] | {"in_legend": True}
        if len(members) == 1:
            yield Line(x=members[0].times_s, y=members[0].values, runs=members[0].run_id, **look)
        else:
            times_s, mean, low, high = fold(members)
            name = f"{look['group']}, {len(members)} repeats"
            yield Line(x=times_s, y=mean, low=low, high=high, **look | {"name": name})


def _repeats(curves: Sequence[Curve], table: RunTable) -> list[list[Curve]]:
    """The curves of good runs by configuration, each failed run alone."""
    rows = table.frame[["run_id", "configuration_id", FAILED]].itertuples(index=False, name=None)
    keys = {
        run: ("failed", run) if isinstance(why, str) else ("good", configuration) for run, configuration, why in rows
    }
    groups: dict[tuple[str, int], list[Curve]] = {}
    for curve in curves:
        groups.setdefault(keys[curve.run_id], []).append(curve)
    return list(groups.values())


def fold(curves: Sequence[Curve]) -> tuple[Array, Array, Array, Array]:
    """Times (s), mean, smallest and largest value of several curves at each time.

    The times are those that all curves cover, so a mean is always over all repeats.
    """
    start_s = max(float(curve.times_s[0]) for curve in curves)
    end_s = min(float(curve.times_s[-1]) for curve in curves)
    times_s = np.linspace(start_s, max(start_s, end_s), _GRID_POINTS)
    values = np.array([_at(times_s, curve) for curve in curves])
    return times_s, values.mean(axis=0), values.min(axis=0), values.max(axis=0)


def _at(times_s: Array, curve: Curve) -> Array:
    known = np.isfinite(curve.values)
    return np.interp(times_s, curve.times_s[known], curve.values[known])


# The time axis that the lines of runs share: the time of the recording.


RECORDING_TIME = Axis("recording time", "s")
FROM_FIRST_FRAME = "The recording time is 0 s at the first frame."
_MOST_RUNS = 200
"""Runs that are asked for their first frame. All runs on a dataset have nearly the same."""


def recording_starts(data: base.PlotData) -> dict[int, float]:
    """{run: timestamp in s at which the recording time of its dataset is 0}, for datasets with a played frame.

    It is the earliest first frame of the runs on a dataset: cameras and LiDARs do not start at the same moment. Good
    and failed runs count, drawn or not, so that all plots of a selection have the same.
    """
    datasets = _datasets(data)
    earliest: dict[str, float] = {}
    for run, dataset in list(datasets.items())[:_MOST_RUNS]:
        first_s = data.files.first_frame_s(run)
        if first_s is not None:
            earliest[dataset] = min(first_s, earliest.get(dataset, first_s))
    return {run: earliest[dataset] for run, dataset in datasets.items() if dataset in earliest}


def _datasets(data: base.PlotData) -> Mapping[int, str]:
    pairs = data.table.frame[["run_id", "dataset"]].itertuples(index=False, name=None)
    return {int(run): str(dataset) for run, dataset in pairs}
