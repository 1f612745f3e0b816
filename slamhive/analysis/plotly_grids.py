"""Heat maps and densities of points as Plotly traces."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from slamhive.analysis.chart import Cells, Chart, Density
from slamhive.analysis.plotly_values import Json, escaped, numbers, translucent

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
    title = f"{mark.label} [{mark.unit}]" if mark.unit else mark.label
    bar: Json = {"title": {"text": escaped(title)}}
    if mark.log:
        ticks = np.linspace(*ends, 5)
        bar |= {"tickvals": ticks.tolist(), "ticktext": [f"{10**tick:.3g}" for tick in ticks]}
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
