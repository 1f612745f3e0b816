"""A plot drawn by matplotlib for print: PDF, SVG and PNG with the same look."""

from __future__ import annotations

import io
import re
import textwrap
import threading
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import EngFormatter

from slamhive.analysis.chart import Array, Axis, Chart, FailedRuns
from slamhive.analysis.density import thinned
from slamhive.analysis.print_marks import draw_failed, draw_mark, plain

WIDTH_INCHES, HEIGHT_INCHES = 6.4, 4.2
DOTS_PER_INCH = 200
_LEGEND_MOST = 24
_LEGEND_LETTERS = 100
_CAPTION_POINTS, _CAPTION_LETTERS, _CAPTION_LINE_INCHES = 6.5, 132, 0.125
"""The caption is part of the file, below the plot."""

_LOOK: Any = {
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "#e3e6ea",
    "grid.linewidth": 0.6,
    "axes.edgecolor": "#7b838c",
    "axes.axisbelow": True,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "slamhive",
}
"""PDF and SVG keep text as text, so that it can be searched and edited."""

_CLIP_NAME = re.compile(rb'(?<=[#"])p[0-9a-f]{10}(?=[)"])')

_lock = threading.Lock()


def print_chart(chart: Chart, file_format: str) -> bytes:
    """Draw the plot as a PDF, SVG or PNG file; equal plots give equal bytes."""
    with _lock, mpl.rc_context(_LOOK):  # the settings of matplotlib are global
        lines = textwrap.wrap(plain(chart.caption), _CAPTION_LETTERS)
        heights = HEIGHT_INCHES * chart.height, _CAPTION_LINE_INCHES * (len(lines) + 1)
        figure = Figure(figsize=(WIDTH_INCHES, sum(heights)), layout="constrained")
        FigureCanvasAgg(figure)
        parts: Any = figure.subfigures(2, height_ratios=heights)
        plot, words = parts
        _draw(plot, thinned(chart))
        words.text(0.02, 1.0, "\n".join(lines), fontsize=_CAPTION_POINTS, va="top", color="#555b61", linespacing=1.25)
        _settle_layout(figure)
        buffer = io.BytesIO()
        metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(file_format)
        figure.savefig(buffer, format=file_format, dpi=DOTS_PER_INCH, metadata=metadata)
    return _numbered_clips(buffer.getvalue()) if file_format == "svg" else buffer.getvalue()


def _settle_layout(figure: Figure) -> None:
    """Compute the layout, and round it: the last digits of the layout solver are random."""
    engine = figure.get_layout_engine()
    assert engine is not None, "set by the caller"
    engine.execute(figure)
    figure.set_layout_engine("none")
    for part in figure.subfigs:  # they contain legends and titles
        part.bbox_relative.set_points(np.round(part.bbox_relative.get_points(), 9))
    for axes in figure.axes:
        left, bottom, width, height = (round(value, 9) for value in axes.get_position(original=True).bounds)
        axes.set_position((left, bottom, width, height))


def _numbered_clips(svg: bytes) -> bytes:
    """Number the clipping areas: matplotlib names them by a hash of all digits of their coordinates."""
    names: dict[bytes, bytes] = {}
    return _CLIP_NAME.sub(lambda found: names.setdefault(found[0], b"clip%d" % len(names)), svg)


def _draw(figure: SubFigure, chart: Chart) -> None:
    failed = [mark for mark in chart.marks if isinstance(mark, FailedRuns)] if chart.z is None else []
    band = None
    if any(np.isfinite(mark.x).any() for mark in failed):
        band, axes = figure.subplots(2, sharex=True, height_ratios=[1, 9])
    elif chart.z is not None:
        axes = figure.add_subplot(projection="3d")
    else:
        axes = figure.add_subplot()
    figure.suptitle(plain(chart.title), fontsize=10)
    for mark in chart.marks:
        draw_mark(axes, mark, chart)
    _dress(axes, chart)
    if band is not None:
        draw_failed(band, chart)
    handles, labels = axes.get_legend_handles_labels()
    if 1 < len(labels) <= _LEGEND_MOST:
        columns = max(1, min(6, _LEGEND_LETTERS // (max(map(len, labels)) + 5)))
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=7, frameon=False)


def _dress(axes: Any, chart: Chart) -> None:
    if chart.bare:
        axes.set_axis_off()
        axes.margins(x=chart.bare_margin, y=0.12)  # labels beside the lines
        return
    _dress_axis(axes, "x", chart.x)
    _dress_axis(axes, "y", chart.y)
    if chart.z is not None:
        _dress_axis(axes, "z", chart.z)
    if chart.equal_aspect:
        axes.set_aspect("equal", **({} if chart.z is not None else {"adjustable": "datalim"}))


def _dress_axis(axes: Any, name: str, axis: Axis) -> None:
    getattr(axes, f"set_{name}label")(plain(axis.title))
    if axis.categories is not None:
        places: Array = np.arange(len(axis.categories))
        long = name == "x" and sum(map(len, axis.categories)) > 60
        getattr(axes, f"set_{name}ticks")(
            places,
            [plain(category) for category in axis.categories],
            **({"rotation": 30, "ha": "right"} if long else {}),
        )
        return
    if axis.log:
        getattr(axes, f"set_{name}scale")("log")
    if axis.unit == "bytes":
        getattr(axes, f"{name}axis").set_major_formatter(EngFormatter())
