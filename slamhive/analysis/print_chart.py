"""A plot drawn by matplotlib for print: PDF, SVG and PNG with the same look, and PDF for the columns of a paper."""

from __future__ import annotations

import io
import re
import textwrap
import threading
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, NullFormatter

from slamhive.analysis.chart import PAPER_FORMATS, THUMBNAIL, Array, Axis, Chart, FailedRuns, Font
from slamhive.analysis.density import thinned
from slamhive.analysis.print_marks import draw_failed, draw_mark, plain

DOTS_PER_INCH = 200
_MM_PER_INCH = 25.4
_LEGEND_MOST = 24
_CAPTION_POINTS, _CAPTION_LETTERS, _CAPTION_LINE_INCHES = 6.5, 132, 0.125
"""The caption is part of the file, below the plot."""

_LOOK: Any = {
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

_FONTS: dict[Font, Any] = {
    "serif": {"font.family": "STIXGeneral", "mathtext.fontset": "stix"},
    "sans": {"font.family": "DejaVu Sans"},
}
"""Fonts that come with matplotlib, so that every machine draws the same. STIX looks like Times."""


@dataclass(frozen=True, slots=True)
class _Sheet:
    """The size of a plot in inches, its text in points, and whether title and caption are part of it.

    Without them, ``height`` is that of the area of the data: legend and labels add theirs.
    """

    width: float
    height: float
    text: float
    worded: bool

    def letters(self, default: float) -> float:
        """How many letters fit, if ``default`` fit into a plot with title and caption."""
        return default * self.width / _WORDED.width


_WORDED = _Sheet(6.4, 4.2, 9, worded=True)
_SHEETS = {
    "88mm.pdf": _Sheet(88 / _MM_PER_INCH, 48 / _MM_PER_INCH, 8, worded=False),
    "180mm.pdf": _Sheet(180 / _MM_PER_INCH, 70 / _MM_PER_INCH, 8, worded=False),
    THUMBNAIL: _Sheet(3.2, 1.7, 7, worded=False),
}

_CLIP_NAME = re.compile(rb'(?<=[#"])p[0-9a-f]{10}(?=[)"])')

_lock = threading.Lock()


def print_chart(chart: Chart, ending: str, font: Font | None = None) -> bytes:
    """Draw the plot as a file; equal plots give equal bytes.

    Args:
        chart: The plot.
        ending: One of :data:`~slamhive.analysis.chart.PRINT_FORMATS` or ``PAPER_FORMATS``, or ``THUMBNAIL``.
        font: The font; None for serif in the columns of a paper, and sans otherwise.
    """
    sheet = _SHEETS.get(ending, _WORDED)
    file_format = ending.rpartition(".")[2]
    look = {**_LOOK, **_FONTS[font or ("serif" if ending in PAPER_FORMATS else "sans")], "font.size": sheet.text}
    with _lock, mpl.rc_context(look):  # the settings of matplotlib are global
        figure = _captioned(chart, sheet) if sheet.worded else _bare(chart, sheet)
        _settle_layout(figure)
        buffer = io.BytesIO()
        metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(file_format)
        figure.savefig(buffer, format=file_format, dpi=DOTS_PER_INCH, metadata=metadata)
    return _numbered_clips(buffer.getvalue()) if file_format == "svg" else buffer.getvalue()


def _captioned(chart: Chart, sheet: _Sheet) -> Figure:
    lines = textwrap.wrap(plain(chart.caption), _CAPTION_LETTERS)
    heights = sheet.height * chart.height, _CAPTION_LINE_INCHES * (len(lines) + 1)
    figure = Figure(figsize=(sheet.width, sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    parts: Any = figure.subfigures(2, height_ratios=heights)
    plot, words = parts
    _draw(plot, thinned(chart), sheet)
    words.text(0.02, 1.0, "\n".join(lines), fontsize=_CAPTION_POINTS, va="top", color="#555b61", linespacing=1.25)
    return figure


def _bare(chart: Chart, sheet: _Sheet) -> Figure:
    figure = Figure(figsize=(sheet.width, sheet.height * chart.height), layout="constrained")
    FigureCanvasAgg(figure)
    plot: Any = figure.subfigures(1)
    _draw(plot, thinned(chart), sheet)
    figure.set_size_inches(sheet.width, sheet.height * chart.height + _around_inches(figure, plot))
    return figure


def _around_inches(figure: Figure, plot: SubFigure) -> float:
    """The height of the legend, and of the labels below the lowest axes."""
    labels = plot.axes[-1].xaxis.get_tightbbox()
    boxes = [legend.get_window_extent() for legend in plot.legends] + ([] if labels is None else [labels])
    return float(sum(box.height for box in boxes)) / figure.dpi


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


def _draw(figure: SubFigure, chart: Chart, sheet: _Sheet) -> None:
    failed = [mark for mark in chart.marks if isinstance(mark, FailedRuns)] if chart.z is None else []
    band = None
    if any(np.isfinite(mark.x).any() for mark in failed):
        band, axes = figure.subplots(2, sharex=True, height_ratios=[1, 9])
    elif chart.z is not None:
        axes = figure.add_subplot(projection="3d")
    else:
        axes = figure.add_subplot()
    if sheet.worded:
        figure.suptitle(plain(chart.title), fontsize=10)
    for mark in chart.marks:
        draw_mark(axes, mark, chart)
    _dress(axes, chart, sheet)
    if band is not None:
        draw_failed(band, chart)
    handles, labels = axes.get_legend_handles_labels()
    if 1 < len(labels) <= _LEGEND_MOST:
        columns = max(1, min(6, int(sheet.letters(100 if sheet.worded else 130) // (max(map(len, labels)) + 5))))
        tight = {} if sheet.worded else {"columnspacing": 1.0, "handlelength": 1.4, "labelspacing": 0.3}
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=7, frameon=False, **tight)


def _dress(axes: Any, chart: Chart, sheet: _Sheet) -> None:
    if chart.bare:
        axes.set_axis_off()
        axes.margins(x=chart.bare_margin(sheet.letters(140)), y=0.12)  # labels beside the lines
        return
    _dress_axis(axes, "x", chart.x, sheet)
    _dress_axis(axes, "y", chart.y, sheet)
    if chart.z is not None:
        _dress_axis(axes, "z", chart.z, sheet)
    if chart.equal_aspect:
        axes.set_aspect("equal", **({} if chart.z is not None else {"adjustable": "datalim"}))


def _dress_axis(axes: Any, name: str, axis: Axis, sheet: _Sheet) -> None:
    getattr(axes, f"set_{name}label")(plain(axis.title))
    if axis.categories is not None:
        places: Array = np.arange(len(axis.categories))
        long = name == "x" and sum(map(len, axis.categories)) > sheet.letters(60)
        getattr(axes, f"set_{name}ticks")(
            places,
            [plain(category) for category in axis.categories],
            **({"rotation": 30, "ha": "right"} if long else {}),
        )
        return
    drawn = getattr(axes, f"{name}axis")
    if axis.log:
        getattr(axes, f"set_{name}scale")("log")
        low, high = getattr(axes, f"get_{name}lim")()
        few = high <= _MOST_FINE_SPAN * low
        drawn.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=_MOST_LOG_LABELS))
        drawn.set_major_formatter(_PLAIN)
        drawn.set_minor_formatter(NullFormatter())
    if axis.unit == "bytes":
        drawn.set_major_formatter(EngFormatter())


_MOST_FINE_SPAN = 200
"""A logarithmic axis over a larger factor has labels at powers of ten only."""
_MOST_LOG_LABELS = 8
_PLAIN: Any = FuncFormatter(lambda value, _place: f"{value:g}")
