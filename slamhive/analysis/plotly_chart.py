"""A plot as interactive Plotly JSON, made without the plotly package, whose import takes a second.

The page sets colours that depend on light or dark mode: marks of :data:`~slamhive.analysis.chart.REFERENCE` carry
``meta: theme:groundtruth``. Numbers are typed arrays in base64, which are smaller and faster than text.
"""

from __future__ import annotations

import numpy as np

from slamhive.analysis.chart import Axis, Bars, Boxes, Cells, Chart, Density, FailedRuns, Parallel, Points, Segments
from slamhive.analysis.density import SINGLE_MOST, thinned
from slamhive.analysis.plotly_marks import MOST_LEVEL_DIMENSIONS, traces_of
from slamhive.analysis.plotly_values import Json, drawable, escaped, numbers, with_dark_colours

LEGEND_MOST = 40
"""A longer legend would hide the plot; hovering shows the name of a mark."""

_FAILED_BAND = (0.9, 1.0)
_CAMERA = {"eye": {"x": 1.6, "y": -1.7, "z": 1.0}, "center": {"x": 0.0, "y": 0.0, "z": -0.15}}


def plotly_figure(chart: Chart) -> Json:
    """``{"data": [...], "layout": {...}}``, with escaped text."""
    drawn = thinned(chart)
    data = [trace for mark in drawn.marks for trace in traces_of(mark, drawn)]
    figure = with_dark_colours({"data": data, "layout": _layout(drawn)})
    return figure | {"zoom": _zoom(chart, drawn)} if any(isinstance(m, Density) for m in drawn.marks) else figure


def _zoom(chart: Chart, drawn: Chart) -> Json:
    """All points: the page draws them where a visitor has zoomed into a part with few points. One trace per mark.

    ``first`` is the index of the first of these traces in the data, after the same number of densities.
    """
    clouds = [mark for mark in chart.marks if isinstance(mark, Points) and len(mark.x)]
    return {
        "most": SINGLE_MOST,
        "first": sum(isinstance(mark, Density) for mark in drawn.marks),
        "points": [
            {"x": numbers(mark.x), "y": numbers(mark.y)} | ({} if mark.runs is None else {"runs": numbers(mark.runs)})
            for mark in clouds
        ],
    }


def _layout(chart: Chart) -> Json:
    layout: Json = {
        "legend": {"orientation": "h", "yanchor": "bottom", "y": 1.02, "xanchor": "left", "x": 0.0},
        "height": round(440 * chart.height),
        "hovermode": "closest",
        "showlegend": 1 < chart.legend_entries <= LEGEND_MOST,
    }
    if chart.z is not None:
        scene = {f"{name}axis": _axis(axis) for name, axis in zip("xyz", (chart.x, chart.y, chart.z), strict=True)}
        return layout | {"scene": scene | {"aspectmode": "data" if chart.equal_aspect else "cube", "camera": _CAMERA}}
    x, y = _axis(chart.x), _axis(chart.y)
    if any(isinstance(mark, FailedRuns) and drawable(mark.x, chart.x).any() for mark in chart.marks):
        y["domain"] = [0, _FAILED_BAND[0] - 0.03]
        layout["yaxis2"] = {
            "domain": list(_FAILED_BAND),
            "range": [0, 1],
            "tickvals": [0.5],
            "ticktext": [f"{sum(m.total for m in chart.marks if isinstance(m, FailedRuns))} failed"],
            "showgrid": False,
            "zeroline": False,
            "fixedrange": True,
            "automargin": True,
        }
        layout["shapes"] = [
            {
                "type": "rect", "xref": "paper", "yref": "paper", "x0": 0, "x1": 1,
                "y0": _FAILED_BAND[0], "y1": _FAILED_BAND[1],
                "fillcolor": "rgba(213,94,0,0.10)", "line": {"width": 0}, "layer": "below",
            }
        ]  # fmt: skip
    if chart.equal_aspect:
        y |= {"scaleanchor": "x"}
        x |= {"constrain": "domain"}
        y |= {"constrain": "domain"}
    if chart.bare:
        x |= {"visible": False, "range": _bare_range(chart)}
        y |= {"visible": False}
    if any(isinstance(mark, Bars) for mark in chart.marks):
        y |= {"rangemode": "tozero"}
    if any(isinstance(mark, Boxes) for mark in chart.marks):
        layout["boxmode"] = "group"
    if any(isinstance(mark, Cells) for mark in chart.marks):
        x |= {"showgrid": False}
        y |= {"showgrid": False}
    parallel = [mark for mark in chart.marks if isinstance(mark, Parallel)]
    if parallel:
        return layout | {"margin": _parallel_margin(parallel[0])}
    return layout | {"xaxis": x, "yaxis": y}


def _parallel_margin(mark: Parallel) -> Json:
    """Space for the categories of the first axis on its left, and for slanted titles above."""
    first = mark.dimensions[0].axis.categories or ()
    slanted = len(mark.dimensions) > MOST_LEVEL_DIMENSIONS
    longest = max(len(dimension.axis.title) for dimension in mark.dimensions)
    return {"l": 24 + 6 * max(map(len, first), default=4), "t": 44 + (2 * longest if slanted else 0), "r": 32, "b": 24}


def _bare_range(chart: Chart) -> list[float]:
    ends = [part for mark in chart.marks if isinstance(mark, Segments) for part in (mark.x0, mark.x1)]
    places = np.concatenate(ends) if ends else np.zeros(1)
    room = chart.bare_margin() * float(np.ptp(places))
    return [float(places.min()) - room, float(places.max()) + room]


def _axis(axis: Axis) -> Json:
    entry: Json = {"title": {"text": escaped(axis.title)}, "automargin": True}
    if axis.categories is not None:
        names = [escaped(name) for name in axis.categories]
        if axis.numbered:
            return entry | {"tickvals": list(range(len(names))), "ticktext": names, "range": [-0.5, len(names) - 0.5]}
        return entry | {"type": "category", "categoryorder": "array", "categoryarray": names}
    if axis.unit == "bytes":
        entry |= {"exponentformat": "SI"}
    # Plotly's own labels: in a part of a decade single digits, where a format of ours would make all labels long.
    return entry | ({"type": "log"} if axis.log else {})
