"""A chart as an interactive figure: plain Plotly JSON, made without the plotly package (whose import takes a second).

Colours that depend on light or dark are left to the page: marks of :data:`~slamhive.analysis.chart.REFERENCE` carry
``meta: theme:groundtruth``. Numbers travel as typed arrays in base64, which is smaller and faster than text.
"""

from __future__ import annotations

import numpy as np

from slamhive.analysis.chart import BARE_MARGIN, Axis, Bars, Boxes, Chart, FailedRuns, Line, Points, Segments
from slamhive.analysis.plotly_marks import traces_of
from slamhive.analysis.plotly_values import Json, drawable, escaped

LEGEND_MOST = 40
"""A longer legend would hide the plot; hovering tells what a mark is."""

_FAILED_BAND = (0.9, 1.0)


def plotly_figure(chart: Chart) -> Json:
    """``{"data": [...], "layout": {...}}``; words from outside are escaped, Plotly reads some of HTML in them."""
    data = [trace for mark in chart.marks for trace in traces_of(mark, chart)]
    return {"data": data, "layout": _layout(chart)}


def _layout(chart: Chart) -> Json:
    layout: Json = {
        "legend": {"orientation": "h", "yanchor": "bottom", "y": 1.02, "xanchor": "left", "x": 0.0},
        "height": round(440 * chart.height),
        "hovermode": "closest",
        "showlegend": 1 < sum(isinstance(mark, Points | Line | Bars | Boxes) for mark in chart.marks) <= LEGEND_MOST,
    }
    if chart.z is not None:
        scene = {f"{name}axis": _axis(axis) for name, axis in zip("xyz", (chart.x, chart.y, chart.z), strict=True)}
        return layout | {"scene": scene | ({"aspectmode": "data"} if chart.equal_aspect else {})}
    x, y = _axis(chart.x), _axis(chart.y)
    if any(isinstance(mark, FailedRuns) and drawable(mark.x, chart.x).any() for mark in chart.marks):
        y["domain"] = [0, _FAILED_BAND[0] - 0.03]
        layout["yaxis2"] = {
            "domain": list(_FAILED_BAND),
            "range": [0, 1],
            "tickvals": [0.5],
            "ticktext": ["failed"],
            "showgrid": False,
            "zeroline": False,
            "fixedrange": True,
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
    return layout | {"xaxis": x, "yaxis": y}


def _bare_range(chart: Chart) -> list[float]:
    ends = [part for mark in chart.marks if isinstance(mark, Segments) for part in (mark.x0, mark.x1)]
    places = np.concatenate(ends) if ends else np.zeros(1)
    room = BARE_MARGIN * float(np.ptp(places))
    return [float(places.min()) - room, float(places.max()) + room]


def _axis(axis: Axis) -> Json:
    entry: Json = {"title": {"text": escaped(axis.title)}, "automargin": True}
    if axis.categories is not None:
        names = [escaped(name) for name in axis.categories]
        return entry | {"type": "category", "categoryorder": "array", "categoryarray": names}
    return entry | ({"type": "log"} if axis.log else {})
