"""A plot as interactive Plotly JSON, made without the plotly package, whose import takes a second.

The page sets colours that depend on light or dark mode: marks of :data:`~slamhive.analysis.chart.REFERENCE` carry
``meta: theme:groundtruth``. Numbers are typed arrays in base64, which are smaller and faster than text.
"""

from __future__ import annotations

import base64
import html
import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from slamhive.analysis.chart import (
    FAILED_MARKER,
    REFERENCE,
    SINGLE_MOST,
    Array,
    Axis,
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
    failed_rows,
    line_width,
    on_dark,
    thinned,
    titled,
)

# Numbers, text and colours in the JSON of Plotly.


THEMED = "theme:groundtruth"

Json = dict[str, Any]


def with_dark_colours(figure: Json) -> Json:
    """The plot with the colours for dark pages, {colour: its lighter one}, in its layout; changes ``figure``."""
    lighter = {colour: on_dark(colour) for colour in sorted(set(_colours(figure["data"])))}
    figure["layout"]["meta"] = {"dark": {colour: other for colour, other in lighter.items() if colour != other}}
    return figure


def _colours(part: object) -> Iterator[str]:
    if isinstance(part, str):
        yield from _COLOUR.findall(part)
    elif isinstance(part, dict | list):
        for entry in part.values() if isinstance(part, dict) else part:
            yield from _colours(entry)


_COLOUR = re.compile(r"^#[0-9A-Fa-f]{6}$")


def numbers(values: Array) -> Json:
    """A typed array for Plotly: integers as int32, other numbers in single precision, enough for a screen."""
    whole = np.issubdtype(values.dtype, np.integer)
    wanted = np.ascontiguousarray(values, dtype="<i4" if whole else "<f4")
    content: Json = {"dtype": "i4" if whole else "f4", "bdata": base64.b64encode(wanted.tobytes()).decode()}
    if values.ndim > 1:
        content["shape"] = ", ".join(map(str, values.shape))
    return content


def escaped(text: str) -> str:
    """Text for Plotly, which interprets some HTML and ``%{...}``."""
    return html.escape(text, quote=False).replace("%{", "%\u200b{").replace("\n", "<br>")


def translucent(colour: str, opacity: float) -> str:
    """``#0072B2`` as ``rgba(0,114,178,0.2)``."""
    if not colour.startswith("#"):
        return f"rgba(128,128,128,{opacity:g})"
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity:g})"


def colour_of_mark(colour: str) -> str:
    """The colour to draw with; the page replaces the colour of references."""
    return "#555555" if colour == REFERENCE else colour


def meta_of(colour: str) -> Json:
    """Marks a reference, so that the page adapts its colour to light or dark mode."""
    return {"meta": THEMED} if colour == REFERENCE else {}


def drawable(x: Array, axis: Axis) -> Array:
    """Mark the values that an axis can show: numbers, and only positive ones if it is logarithmic."""
    return np.isfinite(x) & (x > 0) if axis.log else np.isfinite(x)


def positions(values: Array, axis: Axis) -> Any:
    """Values for Plotly, which expects the names of categories instead of their positions."""
    if axis.categories is None or axis.numbered:
        return numbers(values)
    return [None if not np.isfinite(place) else escaped(axis.categories[int(place)]) for place in values]


# Heat maps and densities of points as Plotly traces.


SCALE = "Viridis"
_STOPS = 9


def density(mark: Density, chart: Chart) -> list[Json]:
    """One colour from pale to full over decades; empty cells are transparent."""
    edges = [10**e if axis.log else e for e, axis in ((mark.x_edges, chart.x), (mark.y_edges, chart.y))]
    return [
        {
            "type": "heatmap",
            "name": escaped(mark.name),
            "x": numbers(edges[0]),
            "y": numbers(edges[1]),
            "z": numbers(np.where(mark.counts > 0, mark.counts, np.nan)),
            "zmin": 0,
            "zmax": mark.most,
            "colorscale": _over_decades(mark),
            "showscale": False,
            "hoverongaps": False,
            "legendgroup": escaped(mark.group or mark.name),
            "hovertemplate": f"%{{z}} runs of {escaped(mark.name)}<extra></extra>",
        }
    ]


def _over_decades(mark: Density) -> list[list[Any]]:
    """A colour scale that is linear in the logarithm of the counts, from 1 to the maximum."""
    shares = np.linspace(0, 1, _STOPS)
    stops = [[float(mark.most**share / mark.most), translucent(mark.colour, 0.3 + 0.7 * share)] for share in shares]
    stops[-1][0] = 1.0
    return [[0.0, stops[0][1]], *stops] if mark.most > 1 else [[0.0, stops[-1][1]], [1.0, stops[-1][1]]]


def cells(mark: Cells, chart: Chart) -> list[Json]:
    """A heat map with text in its cells."""
    values = np.log10(mark.values) if mark.log else mark.values
    low, high = mark.span or (float(np.nanmin(mark.values, initial=np.inf)), float(np.nanmax(mark.values, initial=0.0)))
    ends = (math.log10(low), math.log10(high)) if mark.log else (low, high)
    bar: Json = {"title": {"text": escaped(titled(mark.label, mark.unit))}}
    if mark.unit == "bytes":
        bar |= _IN_BYTES
    if mark.log:
        ticks = np.linspace(*ends, 5)
        texts = [_prefixed(10**tick) if mark.unit == "bytes" else f"{10**tick:.3g}" for tick in ticks]
        bar |= {"tickvals": ticks.tolist(), "ticktext": texts}
    return [
        {
            "type": "heatmap",
            "x": [escaped(name) for name in chart.x.categories or ()],
            "y": [escaped(name) for name in chart.y.categories or ()],
            "z": numbers(values),
            **({"zmin": ends[0], "zmax": ends[1]} if mark.span else {}),
            "text": [
                [escaped(text) if known else "" for text, known in zip(*row, strict=True)]
                for row in zip(mark.texts, np.isfinite(mark.values), strict=True)
            ],
            "texttemplate": "%{text}",
            "colorscale": SCALE,
            "reversescale": mark.lower_is_better,
            "colorbar": bar,
            "hoverongaps": False,
            "hovertemplate": "%{x}<br>%{y}<br>%{text}<extra></extra>",
            "xgap": 1,
            "ygap": 1,
        },
        *_text_of_empty_cells(mark, chart),
    ]


def _text_of_empty_cells(mark: Cells, chart: Chart) -> list[Json]:
    """The text of empty cells; Plotly would colour it for the background of a filled cell."""
    rows, columns = np.nonzero(~np.isfinite(mark.values))
    places = [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if mark.texts[r][c]]
    if not places:
        return []
    x, y = chart.x.categories or (), chart.y.categories or ()
    return [
        {
            "type": "scatter",
            "mode": "text",
            "x": [escaped(x[column]) for _, column in places],
            "y": [escaped(y[row]) for row, _ in places],
            "text": [escaped(mark.texts[row][column]) for row, column in places],
            "hoverinfo": "skip",
            "showlegend": False,
        }
    ]


# The marks of a plot as Plotly traces.


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
    axes = {"x": chart.x, "y": chart.y} | ({} if chart.z is None else {"z": chart.z})
    parts = [
        f"{escaped(axis.label)}: %{{{name}}} {'' if axis.unit == 'bytes' else escaped(axis.unit)}"
        for name, axis in axes.items()
    ]
    more: Json = {}
    if mark.texts is not None:
        more["text"] = [escaped(text) for text in mark.texts]
        parts.append("%{text}")
    if mark.runs is not None:
        more["customdata"] = numbers(mark.runs)
        parts.append("run %{customdata}")
    return [
        trace
        | _error_bars(mark.y, mark.low, mark.high)
        | (more | {"hovertemplate": "<br>".join(parts) + f"<extra>{escaped(mark.name)}</extra>"})
    ]


def _error_bars(middle: Array, low: Array | None, high: Array | None) -> Json:
    if low is None or high is None:
        return {}
    bars = {"type": "data", "symmetric": False, "array": numbers(high - middle), "arrayminus": numbers(middle - low)}
    return {"error_y": bars | {"thickness": 1.2}}


def _in_legend(mark: Points | Line) -> Json:
    return {"showlegend": mark.in_legend, "legendgroup": escaped(mark.group or mark.name)}


_IN_BYTES: Json = {"exponentformat": "SI", "ticksuffix": "B"}
"""Numbers at an axis such as 500MB. Hovering shows values in the same way."""


def _prefixed(count: float) -> str:
    """``500 MB``."""
    power = max(0, min(4, int(math.log10(count) // 3))) if count >= 1 else 0
    return f"{count / 1000**power:.3g} {('', 'k', 'M', 'G', 'T')[power]}B"


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
    if mark.medians is None:
        return [trace]
    # Thin bars at the medians, in the same legend group as the bars.
    tops = mark.heights if mark.high is None else mark.high
    thick = _MEDIAN_SHARE * float(np.nanmax(tops, initial=0.0, where=np.isfinite(tops)))
    medians: Json = {
        "type": "bar",
        "name": trace["name"],
        "legendgroup": trace["legendgroup"],
        "offsetgroup": trace["name"],
        "showlegend": False,
        "x": trace["x"],
        "y": numbers(np.where(np.isfinite(mark.medians), thick, np.nan)),
        "base": numbers(mark.medians - thick / 2),
        "marker": {"color": colour_of_mark(REFERENCE)},
        "customdata": numbers(mark.medians),
        "hovertemplate": "median %{customdata:.4g}<extra></extra>",
        **meta_of(REFERENCE),
    }
    return [trace | {"offsetgroup": trace["name"]}, medians]


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


LEGEND_MOST = 40
"""A longer legend would hide the plot; hovering shows the name of a mark."""

_FAILED_BAND = (0.9, 1.0)
_CAMERA = {"eye": {"x": 1.6, "y": -1.7, "z": 1.0}, "center": {"x": 0.0, "y": 0.0, "z": -0.15}}


def plotly_figure(chart: Chart) -> Json:
    """``{"data": [...], "layout": {...}}``, with escaped text."""
    drawn = thinned(chart)
    data = [trace for mark in drawn.marks for trace in traces_of(mark, drawn)]
    figure = with_dark_colours({"data": data, "layout": _layout(drawn)})
    densities = sum(isinstance(mark, Density) for mark in drawn.marks)
    if not densities:
        return figure
    # All points, one trace for each mark: the page draws them where a visitor has zoomed into a part with few points.
    # They come after the densities in the data.
    clouds = [mark for mark in chart.marks if isinstance(mark, Points) and len(mark.x)]
    points = [
        {"x": numbers(mark.x), "y": numbers(mark.y)} | ({} if mark.runs is None else {"runs": numbers(mark.runs)})
        for mark in clouds
    ]
    return figure | {"zoom": {"most": SINGLE_MOST, "first": densities, "points": points}}


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
        ends = [part for mark in chart.marks if isinstance(mark, Segments) for part in (mark.x0, mark.x1)]
        places = np.concatenate(ends) if ends else np.zeros(1)
        room = chart.bare_margin() * float(np.ptp(places))
        x |= {"visible": False, "range": [float(places.min()) - room, float(places.max()) + room]}
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
        # Space for the categories of the first axis on its left, and for slanted titles above.
        mark = parallel[0]
        first = mark.dimensions[0].axis.categories or ()
        slanted = len(mark.dimensions) > MOST_LEVEL_DIMENSIONS
        longest = max(len(dimension.axis.title) for dimension in mark.dimensions)
        return layout | {
            "margin": {
                "l": 24 + 6 * max(map(len, first), default=4),
                "t": 44 + (2 * longest if slanted else 0),
                "r": 32,
                "b": 24,
            }
        }
    return layout | {"xaxis": x, "yaxis": y}


def _axis(axis: Axis) -> Json:
    entry: Json = {"title": {"text": escaped(axis.title)}, "automargin": True}
    if axis.categories is not None:
        names = [escaped(name) for name in axis.categories]
        if axis.numbered:
            return entry | {"tickvals": list(range(len(names))), "ticktext": names, "range": [-0.5, len(names) - 0.5]}
        return entry | {"type": "category", "categoryorder": "array", "categoryarray": names}
    if axis.unit == "bytes":
        entry |= _IN_BYTES
    # Plotly's own labels: in a part of a decade single digits, where a format of ours would make all labels long.
    return entry | ({"type": "log"} if axis.log else {})
