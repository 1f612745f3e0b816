"""The marks of a plot as Plotly traces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from slamhive.analysis.chart import (
    REFERENCE,
    Array,
    Bars,
    Boxes,
    Cells,
    Chart,
    Density,
    FailedRuns,
    Labels,
    Line,
    Mark,
    Parallel,
    Points,
    Segments,
    crowded,
    line_width,
)
from slamhive.analysis.colours import FAILED_MARKER
from slamhive.analysis.density import failed_rows
from slamhive.analysis.plotly_grids import SCALE, cells, density
from slamhive.analysis.plotly_values import (
    Json,
    colour_of_mark,
    drawable,
    escaped,
    meta_of,
    numbers,
    positions,
    translucent,
)

WEBGL_FROM = 2_000
"""Scatter plots with more points use WebGL."""

MOST_LEVEL_LABELS = 20
"""Labels of more bars would overlap, so they are vertical."""

MOST_LEVEL_DIMENSIONS = 6

_OUTLINE = "#8a8f98"
_MEDIAN_SHARE = 0.008
"""Thickness of the line of a median, as a share of the height of the plot."""


def traces_of(mark: Mark, chart: Chart) -> list[Json]:
    """The Plotly traces of one mark; none for failed runs without a value on the x axis."""
    return _DRAWN_BY[type(mark)](mark, chart)


def _points(mark: Points, chart: Chart) -> list[Json]:
    marker: Json = {
        "symbol": mark.marker,
        "size": 4 if len(mark.x) >= WEBGL_FROM or (len(mark.x) and crowded(chart)) else 7,
        "color": colour_of_mark(mark.colour),
    }
    if mark.emphasis:
        marker |= {"size": 11, "line": {"width": 1.5, "color": _OUTLINE}}
    if mark.ring:
        marker |= {"symbol": "circle-open", "size": 12, "line": {"width": 1.5}}
    if mark.shades is not None:
        marker |= {
            "color": numbers(mark.shades),
            "colorscale": SCALE,
            "colorbar": {"title": {"text": escaped(mark.shade_label)}},
        }
    trace: Json = {
        "type": "scattergl" if len(mark.x) >= WEBGL_FROM else "scatter",
        "mode": "markers",
        "name": escaped(mark.name),
        "x": positions(mark.x, chart.x),
        "y": positions(mark.y, chart.y),
        "marker": marker,
        **_in_legend(mark),
        **meta_of(mark.colour),
    }
    if chart.z is not None:
        trace |= {"type": "scatter3d"} | ({} if mark.z is None else {"z": positions(mark.z, chart.z)})
        symbol = "circle-open" if mark.ring else _SYMBOLS_3D.get(mark.marker, "circle")
        marker |= {"size": 8 if mark.ring else 4, "symbol": symbol}
    if not len(mark.x):
        return [trace | {axis: [None] for axis in ("x", "y") + (("z",) if chart.z is not None else ())}]
    return [trace | _error_bars(mark.y, mark.low, mark.high) | _hover(mark, chart)]


def _error_bars(middle: Array, low: Array | None, high: Array | None) -> Json:
    if low is None or high is None:
        return {}
    bars = {"type": "data", "symmetric": False, "array": numbers(high - middle), "arrayminus": numbers(middle - low)}
    return {"error_y": bars | {"thickness": 1.2}}


def _in_legend(mark: Points | Line) -> Json:
    return {"showlegend": mark.in_legend, "legendgroup": escaped(mark.group or mark.name)}


def _hover(mark: Points, chart: Chart) -> Json:
    parts = [f"{escaped(chart.x.label)}: %{{x}} {escaped(chart.x.unit)}", f"{escaped(chart.y.label)}: %{{y}}"]
    parts[1] += f" {escaped(chart.y.unit)}"
    if chart.z is not None:
        parts.append(f"{escaped(chart.z.label)}: %{{z}} {escaped(chart.z.unit)}")
    more: Json = {}
    if mark.texts is not None:
        more["text"] = [escaped(text) for text in mark.texts]
        parts.append("%{text}")
    if mark.runs is not None:
        more["customdata"] = numbers(mark.runs)
        parts.append("run %{customdata}")
    return more | {"hovertemplate": "<br>".join(parts) + f"<extra>{escaped(mark.name)}</extra>"}


def _failed(mark: FailedRuns, chart: Chart) -> list[Json]:
    """Crosses in the band above the plot, spread over rows so that they do not overlap."""
    known = drawable(mark.x, chart.x)
    x, runs = mark.x[known], mark.runs[known]
    if not len(x) or chart.z is not None:
        return []
    return [
        {
            "type": "scattergl" if len(x) >= WEBGL_FROM else "scatter",
            "mode": "markers",
            "name": escaped(mark.name),
            "showlegend": False,
            "legendgroup": escaped(mark.group or mark.name),
            "x": positions(x, chart.x),
            "y": numbers(failed_rows(mark, chart)[known]),
            "yaxis": "y2",
            "marker": {"symbol": "x-thin-open", "size": 6, "color": mark.colour},
            "customdata": numbers(runs),
            "hovertemplate": f"failed<br>{escaped(chart.x.label)}: %{{x}}<br>run %{{customdata}}<extra></extra>",
        }
    ]


def _line(mark: Line, chart: Chart) -> list[Json]:
    shape = {"shape": "hv"} if mark.steps else {}
    dash = {"dash": "dash"} if mark.dashed else {}
    line: Json = {
        "type": "scatter",
        "mode": "lines",
        "name": escaped(mark.name),
        "x": positions(mark.x, chart.x),
        "y": numbers(mark.y),
        "line": {"color": colour_of_mark(mark.colour), "width": line_width(mark, chart), **shape, **dash},
        **_in_legend(mark),
        **meta_of(mark.colour),
    }
    if mark.z is not None:
        line |= {"type": "scatter3d", "z": numbers(mark.z), "line": {**line["line"], "width": 4}}
    if mark.runs:
        line |= {"customdata": [mark.runs] * len(mark.x)}
    if mark.low is None or mark.high is None:
        return [line]
    band = {
        "type": "scatter",
        "mode": "lines",
        "x": positions(np.concatenate([mark.x, mark.x[::-1]]), chart.x),
        "y": numbers(np.concatenate([mark.high, mark.low[::-1]])),
        "fill": "toself",
        "fillcolor": translucent(mark.colour, 0.2),
        "line": {"width": 0},
        "hoverinfo": "skip",
        "showlegend": False,
        "legendgroup": escaped(mark.group or mark.name),
    }
    return [band, line]


def _bars(mark: Bars, chart: Chart) -> list[Json]:
    trace: Json = {
        "type": "bar",
        "name": escaped(mark.name),
        "legendgroup": escaped(mark.name),
        "x": [escaped(name) for name in chart.x.categories or ()],
        "y": numbers(mark.heights),
        "marker": {"color": list(mark.colours) if mark.colours else colour_of_mark(mark.colour)},
        **meta_of(mark.colour),
    }
    if mark.striped:
        pattern = {"shape": "/", "fgcolor": colour_of_mark(mark.colour), "bgcolor": "rgba(0,0,0,0)", "size": 6}
        trace["marker"] |= {"pattern": pattern, "line": {"width": 1, "color": colour_of_mark(mark.colour)}}
    if mark.texts is not None:
        trace["hovertext"] = [escaped(text) for text in mark.texts]
    if mark.texts is not None and mark.low is None:
        many = sum(isinstance(other, Bars) for other in chart.marks) * len(mark.texts) > MOST_LEVEL_LABELS
        turned = {"textangle": -90} if many else {}
        trace |= {"text": trace["hovertext"], "textposition": "outside", "cliponaxis": False, **turned}
    trace |= _error_bars(mark.heights, mark.low, mark.high)
    return [trace] if mark.medians is None else [trace | {"offsetgroup": trace["name"]}, _medians(mark, trace)]


def _medians(mark: Bars, bars: Json) -> Json:
    """Thin bars at the medians, in the same legend group as the bars."""
    medians = np.zeros(0) if mark.medians is None else mark.medians
    tops = mark.heights if mark.high is None else mark.high
    thick = _MEDIAN_SHARE * float(np.nanmax(tops, initial=0.0, where=np.isfinite(tops)))
    return {
        "type": "bar",
        "name": bars["name"],
        "legendgroup": bars["legendgroup"],
        "offsetgroup": bars["name"],
        "showlegend": False,
        "x": bars["x"],
        "y": numbers(np.where(np.isfinite(medians), thick, np.nan)),
        "base": numbers(medians - thick / 2),
        "marker": {"color": colour_of_mark(REFERENCE)},
        "customdata": numbers(medians),
        "hovertemplate": "median %{customdata:.4g}<extra></extra>",
        **meta_of(REFERENCE),
    }


def _boxes(mark: Boxes, _chart: Chart) -> list[Json]:
    trace: Json = {
        "type": "box",
        "name": escaped(mark.name),
        "legendgroup": escaped(mark.name),
        "x": [escaped(name) for name in mark.categories],
        "y": numbers(mark.values),
        "boxpoints": "all" if len(mark.values) < WEBGL_FROM else "outliers",
        "jitter": 0.4,
        "pointpos": 0,
        "marker": {"color": colour_of_mark(mark.colour), "size": 4, "opacity": 0.7},
        "line": {"width": 1.5},
        "fillcolor": translucent(mark.colour, 0.15),
    }
    if mark.runs is not None:
        trace |= {"customdata": numbers(mark.runs), "hovertemplate": "%{y}<br>run %{customdata}"}
    return [trace]


def _segments(mark: Segments, _chart: Chart) -> list[Json]:
    gap = np.full(len(mark.x0), np.nan)
    dash = {"dash": "dash"} if mark.dashed else {}
    trace = {
        "type": "scatter",
        "mode": "lines",
        "name": escaped(mark.name),
        "x": numbers(np.stack([mark.x0, mark.x1, gap], axis=1).ravel()),
        "y": numbers(np.stack([mark.y0, mark.y1, gap], axis=1).ravel()),
        "line": {"color": colour_of_mark(mark.colour), "width": mark.width, **dash},
        "hoverinfo": "skip",
        "showlegend": bool(mark.name),
        **meta_of(mark.colour),
    }
    return [trace]


def _labels(mark: Labels, _chart: Chart) -> list[Json]:
    side = {"left": "middle right", "right": "middle left", "centre": "top center"}[mark.anchor]
    return [
        {
            "type": "scatter",
            "mode": "text",
            "x": numbers(mark.x),
            "y": numbers(mark.y),
            "text": [escaped(text) for text in mark.texts],
            "textposition": side,
            "hoverinfo": "skip",
            "showlegend": False,
        }
    ]


def _parallel(mark: Parallel, _chart: Chart) -> list[Json]:
    dimensions = []
    for dimension in mark.dimensions:
        title = escaped(dimension.axis.title)
        entry: Json = {"label": title, "values": numbers(dimension.values), "tickformat": "~g"}
        if dimension.axis.categories is not None:
            names = dimension.axis.categories
            entry |= {"tickvals": list(range(len(names))), "ticktext": [escaped(name) for name in names]}
        dimensions.append(entry)
    slanted = {"labelangle": -15} if len(dimensions) > MOST_LEVEL_DIMENSIONS else {}
    trace: Json = {
        "type": "parcoords",
        **slanted,
        "dimensions": dimensions,
        "customdata": numbers(mark.runs),
        "line": {
            "color": numbers(mark.shades),
            "colorscale": SCALE,
            "showscale": True,
            "colorbar": {"title": {"text": escaped(mark.shade_axis.title)}},
        },
    }
    return [trace]


_SYMBOLS_3D = {
    "square": "square", "diamond": "diamond", "cross": "cross", "star": "circle-open",
    "triangle-up": "diamond-open", "triangle-down": "square-open", FAILED_MARKER: "x",
}  # fmt: skip

_DRAWN_BY: dict[type[Any], Callable[[Any, Chart], list[Json]]] = {
    Points: _points,
    FailedRuns: _failed,
    Line: _line,
    Bars: _bars,
    Boxes: _boxes,
    Cells: cells,
    Density: density,
    Segments: _segments,
    Labels: _labels,
    Parallel: _parallel,
}
