"""The marks of a chart as Plotly traces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from slamhive.analysis.chart import (
    Bars,
    Boxes,
    Cells,
    Chart,
    FailedRuns,
    Labels,
    Line,
    Mark,
    Parallel,
    Points,
    Segments,
)
from slamhive.analysis.density import bin_points, failed_rows
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
"""Scatters of more points are painted by the graphics card."""

BINNED_FROM = 150_000
"""Of more points than a screen can tell apart, their density is shown."""

SCALE = "Viridis"


def traces_of(mark: Mark, chart: Chart) -> list[Json]:
    """What Plotly draws for one mark; nothing for failed runs that have no place on the x axis."""
    return _DRAWN_BY[type(mark)](mark, chart)


def _points(mark: Points, chart: Chart) -> list[Json]:
    if len(mark.x) > BINNED_FROM and mark.z is None:
        return _binned(mark, chart)
    marker: Json = {
        "symbol": mark.marker,
        "size": 7 if len(mark.x) < WEBGL_FROM else 4,
        "color": colour_of_mark(mark.colour),
    }
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
        "showlegend": mark.in_legend,
        "legendgroup": escaped(mark.name),
        **meta_of(mark.colour),
    }
    if mark.z is not None and chart.z is not None:
        trace |= {"type": "scatter3d", "z": positions(mark.z, chart.z)}
        marker |= {"size": 4, "symbol": _SYMBOLS_3D.get(mark.marker, "circle")}
    if mark.low is not None and mark.high is not None:
        trace["error_y"] = {
            "type": "data",
            "symmetric": False,
            "array": numbers(mark.high - mark.y),
            "arrayminus": numbers(mark.y - mark.low),
            "thickness": 1.2,
        }
    return [trace | _hover(mark, chart)]


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


def _binned(mark: Points, chart: Chart) -> list[Json]:
    density = bin_points(mark.x, mark.y, log_x=chart.x.log, log_y=chart.y.log)
    shown = np.where(density.counts > 0, np.log10(np.maximum(density.counts, 1)), np.nan)
    return [
        {
            "type": "heatmap",
            "name": escaped(mark.name),
            "x": numbers(density.x_centres),
            "y": numbers(density.y_centres),
            "z": numbers(shown),
            "customdata": numbers(density.counts),
            "colorscale": SCALE,
            "colorbar": {"title": {"text": "runs, log10"}},
            "hovertemplate": "%{customdata} runs<extra></extra>",
        }
    ]


def _failed(mark: FailedRuns, chart: Chart) -> list[Json]:
    """Crosses in the band above the plot, spread over rows so that they can be told apart."""
    known = drawable(mark.x, chart.x)
    x, runs = mark.x[known], mark.runs[known]
    if not len(x) or chart.z is not None:
        return []
    return [
        {
            "type": "scattergl" if len(x) >= WEBGL_FROM else "scatter",
            "mode": "markers",
            "name": f"{escaped(mark.name)} ({len(mark.x)})",
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
        "line": {"color": colour_of_mark(mark.colour), "width": 2, **shape, **dash},
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
        "legendgroup": escaped(mark.name),
    }
    return [band, line | {"legendgroup": escaped(mark.name)}]


def _bars(mark: Bars, chart: Chart) -> list[Json]:
    trace: Json = {
        "type": "bar",
        "name": escaped(mark.name),
        "x": [escaped(name) for name in chart.x.categories or ()],
        "y": numbers(mark.heights),
        "marker": {"color": colour_of_mark(mark.colour)},
    }
    if mark.striped:
        trace["marker"]["pattern"] = {"shape": "/", "fgcolor": mark.colour, "bgcolor": "rgba(0,0,0,0)", "size": 6}
    if mark.texts is not None:
        trace |= {"text": [escaped(text) for text in mark.texts], "textposition": "auto"}
    if mark.low is not None and mark.high is not None:
        trace["error_y"] = {
            "type": "data",
            "symmetric": False,
            "array": numbers(mark.high - mark.heights),
            "arrayminus": numbers(mark.heights - mark.low),
        }
    return [trace]


def _boxes(mark: Boxes, _chart: Chart) -> list[Json]:
    trace: Json = {
        "type": "box",
        "name": escaped(mark.name),
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


def _cells(mark: Cells, chart: Chart) -> list[Json]:
    values = np.log10(mark.values) if mark.log else mark.values
    title = f"{mark.label} [{mark.unit}]" if mark.unit else mark.label
    bar: Json = {"title": {"text": escaped(title)}}
    finite = values[np.isfinite(values)]
    if mark.log and len(finite):
        ticks = np.linspace(finite.min(), finite.max(), 5)
        bar |= {"tickvals": ticks.tolist(), "ticktext": [f"{10**tick:.3g}" for tick in ticks]}
    return [
        {
            "type": "heatmap",
            "x": [escaped(name) for name in chart.x.categories or ()],
            "y": [escaped(name) for name in chart.y.categories or ()],
            "z": numbers(values),
            "text": [[escaped(text) for text in row] for row in mark.texts],
            "texttemplate": "%{text}",
            "colorscale": SCALE,
            "reversescale": mark.lower_is_better,
            "colorbar": bar,
            "hoverongaps": False,
            "hovertemplate": "%{x}<br>%{y}<br>%{text}<extra></extra>",
            "xgap": 1,
            "ygap": 1,
        }
    ]


def _segments(mark: Segments, _chart: Chart) -> list[Json]:
    gap = np.full(len(mark.x0), np.nan)
    dash = {"dash": "dash"} if mark.dashed else {}
    trace = {
        "type": "scatter",
        "mode": "lines",
        "name": escaped(mark.name),
        "x": numbers(np.stack([mark.x0, mark.x1, gap], axis=1).ravel()),
        "y": numbers(np.stack([mark.y0, mark.y1, gap], axis=1).ravel()),
        "line": {
            "color": colour_of_mark(mark.colour),
            "width": mark.width,
            **dash,
        },
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
        entry: Json = {"label": escaped(dimension.axis.title), "values": numbers(dimension.values)}
        if dimension.axis.categories is not None:
            names = dimension.axis.categories
            entry |= {"tickvals": list(range(len(names))), "ticktext": [escaped(name) for name in names]}
        dimensions.append(entry)
    trace: Json = {
        "type": "parcoords",
        "dimensions": dimensions,
        "line": {
            "color": numbers(mark.shades),
            "colorscale": SCALE,
            "showscale": True,
            "colorbar": {"title": {"text": escaped(mark.shade_axis.title)}},
        },
    }
    return [trace]


_SYMBOLS_3D = {"square": "square", "diamond": "diamond", "cross": "cross", "star": "x", "triangle-up": "diamond-open"}

_DRAWN_BY: dict[type[Any], Callable[[Any, Chart], list[Json]]] = {
    Points: _points,
    FailedRuns: _failed,
    Line: _line,
    Bars: _bars,
    Boxes: _boxes,
    Cells: _cells,
    Segments: _segments,
    Labels: _labels,
    Parallel: _parallel,
}
