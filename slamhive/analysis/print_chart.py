"""A plot drawn by matplotlib for print: PDF, SVG and PNG with the same look, and PDF for the columns of a paper."""

from __future__ import annotations

import io
import re
import textwrap
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, NullFormatter

from slamhive.analysis.chart import (
    FAILED_MARKER,
    PAPER_FORMATS,
    REFERENCE,
    THUMBNAIL,
    Array,
    Axis,
    Bars,
    Boxes,
    Cells,
    Chart,
    Density,
    FailedRuns,
    Font,
    Labels,
    Line,
    Mark,
    Parallel,
    Points,
    Segments,
    crowded,
    failed_rows,
    line_width,
    thinned,
    titled,
)

# The marks of a plot, drawn by matplotlib.


MOST_LEVEL_LABELS = 20
"""Labels of more bars than these would overlap, they stand upright."""

_SMALLEST_CELL_TEXT, _LARGEST_CELL_TEXT = 6.0, 9.0
"""Sizes of the text in the cells of a map, in points."""
_MAP_SHARE = 0.8
"""How much of the width of its axes a map has; the colour scale takes the rest."""
_LETTER_WIDTH = 0.6
"""The mean width of a letter in its size."""

_REFERENCE_COLOUR = "#3d4247"
_OPEN = "-open"
_MARKERS = {
    "circle": "o", "square": "s", "triangle-up": "^", "diamond": "D",
    "cross": "P", "star": "*", "triangle-down": "v", "pentagon": "p",
    "triangle-left": "<", "triangle-right": ">", "hexagon": "h", "diamond-tall": "d",
    FAILED_MARKER: "x",
}  # fmt: skip


def draw_mark(axes: Any, mark: Mark, chart: Chart) -> None:
    """Draw one mark into matplotlib axes; failed runs have axes of their own, see :func:`draw_failed`."""
    drawn_by = _DRAWN_BY.get(type(mark))
    if drawn_by is not None:
        drawn_by(axes, mark, chart)


def draw_failed(axes: Any, chart: Chart) -> None:
    """Crosses in a tinted band above the plot."""
    axes.set_facecolor("#fbeee5")
    for mark in (mark for mark in chart.marks if isinstance(mark, FailedRuns)):
        axes.plot(mark.x, failed_rows(mark, chart), "x", color=mark.colour, markersize=3, markeredgewidth=0.7)
    axes.set_ylim(0, 1)
    count = sum(mark.total for mark in chart.marks if isinstance(mark, FailedRuns))
    axes.set_yticks([0.5], [f"{count} failed"])
    axes.grid(visible=False)
    axes.tick_params(axis="x", length=0, labelbottom=False)


def plain(text: str) -> str:
    """Text for titles and labels: without line breaks, control characters, and accidental formulas."""
    return "".join(letter if letter.isprintable() else " " for letter in text).replace("$", r"\$")


def _points(axes: Any, mark: Points, chart: Chart) -> None:
    places = (mark.x, mark.y) if mark.z is None else (mark.x, mark.y, mark.z)
    if chart.z is not None and mark.z is None:
        places = (mark.x, mark.y, np.zeros(0))  # only an entry of the legend
    hollow = mark.marker.endswith(_OPEN)
    look: dict[str, Any] = {
        "s": 6 if crowded(chart) else 16,
        "marker": _MARKERS.get(mark.marker.removesuffix(_OPEN), "o"),
        "linewidths": 0.8 if hollow else 0,
        "alpha": 0.85,
    }
    if mark.emphasis:
        look |= {"s": 36, "linewidths": 0.8, "edgecolors": "black", "zorder": 3}
    if mark.ring:
        look |= {"s": 4 * look["s"], "linewidths": 0.8}
        axes.scatter(*places, facecolors="none", edgecolors=_colour(mark.colour), label=plain(mark.name), **look)
    elif mark.shades is None:
        label = plain(mark.name) if mark.in_legend else None
        face = {"facecolors": "none", "edgecolors": _colour(mark.colour)} if hollow else {"color": _colour(mark.colour)}
        axes.scatter(*places, label=label, **{**face, **look})
    else:
        shaded = axes.scatter(*places, c=mark.shades, cmap="viridis", label=plain(mark.name), **look)
        axes.get_figure().colorbar(shaded, ax=axes, label=plain(mark.shade_label))
    if mark.low is not None and mark.high is not None and mark.z is None:
        reach = np.stack([mark.y - mark.low, mark.high - mark.y])
        axes.errorbar(mark.x, mark.y, np.maximum(reach, 0), fmt="none", ecolor=_colour(mark.colour), elinewidth=0.9)


def _density(axes: Any, mark: Density, chart: Chart) -> None:
    colour = mpl.colors.to_rgb(_colour(mark.colour))
    shades = mpl.colors.LinearSegmentedColormap.from_list(mark.name, [(*colour, 0.3), (*colour, 1.0)])
    counts = np.where(mark.counts > 0, mark.counts.astype(float), np.nan)
    edges = [10**e if axis.log else e for e, axis in ((mark.x_edges, chart.x), (mark.y_edges, chart.y))]
    norm = mpl.colors.LogNorm(1, max(mark.most, 2))
    axes.use_sticky_edges = False  # the outermost points are not to be cut
    axes.pcolormesh(*edges, counts, cmap=shades, norm=norm, rasterized=True, linewidth=0)


def _line(axes: Any, mark: Line, chart: Chart) -> None:
    places = (mark.x, mark.y) if mark.z is None else (mark.x, mark.y, mark.z)
    look: dict[str, Any] = {"color": _colour(mark.colour), "linewidth": 0.65 * line_width(mark, chart)}
    look |= {"label": plain(mark.name)} if mark.in_legend else {}
    look |= {"linestyle": "--"} if mark.dashed else {}
    look |= {"drawstyle": "steps-post"} if mark.steps else {}
    axes.plot(*places, **look)
    if mark.low is not None and mark.high is not None and mark.z is None:
        axes.fill_between(mark.x, mark.low, mark.high, color=_colour(mark.colour), alpha=0.2, linewidth=0)


def _bars(axes: Any, mark: Bars, chart: Chart) -> None:
    width, offset = _share(chart, mark)
    x = np.arange(len(mark.heights)) + offset
    look: dict[str, Any] = {"width": width, "label": plain(mark.name)}
    if mark.striped:
        look |= {"facecolor": "white", "edgecolor": _colour(mark.colour), "hatch": "////", "linewidth": 0.8}
    else:
        look |= {"color": list(mark.colours) if mark.colours else _colour(mark.colour)}
    if mark.low is not None and mark.high is not None:
        reach = np.stack([mark.heights - mark.low, mark.high - mark.heights])
        look |= {"yerr": np.where(np.isfinite(reach), np.maximum(reach, 0), 0), "error_kw": {"elinewidth": 0.9}}
    axes.bar(x, mark.heights, **look)
    if mark.medians is not None:
        axes.hlines(mark.medians, x - 0.4 * width, x + 0.4 * width, colors=_REFERENCE_COLOUR, linewidth=1.2)
    if mark.low is not None:
        return  # text would cover the whiskers
    axes.margins(y=0.15)
    turned = {"rotation": 90} if len(mark.heights) / width > MOST_LEVEL_LABELS else {}
    for place, height, text in zip(x, mark.heights, mark.texts or (), strict=False):
        if np.isfinite(height):
            axes.annotate(f" {plain(text)}", (place, height), ha="center", va="bottom", fontsize=6, **turned)


def _boxes(axes: Any, mark: Boxes, chart: Chart) -> None:
    names = list(chart.x.categories or ())
    width, offset = _share(chart, mark)
    places = np.array([names.index(category) for category in mark.categories], dtype=int)
    colour = _colour(mark.colour)
    face = (*mpl.colors.to_rgb(colour), 0.15)
    axes.scatter([], [], marker="s", s=30, facecolors=[face], edgecolors=colour, label=plain(mark.name))
    for place in np.unique(places):
        values = mark.values[(places == place) & np.isfinite(mark.values)]
        if not len(values):
            continue
        at = place + offset
        look = {"boxprops": {"edgecolor": colour, "facecolor": face}, "patch_artist": True}
        look |= {f"{part}props": {"color": colour} for part in ("whisker", "cap", "median")}
        axes.boxplot([values], positions=[at], widths=width * 0.8, manage_ticks=False, showfliers=False, **look)
        spread = at + (np.arange(len(values)) % 5 - 2) * width * 0.08
        axes.plot(spread, values, "o", color=colour, markersize=2, alpha=0.6)


def _share(chart: Chart, mark: Mark) -> tuple[float, float]:
    """Width and offset of one group of bars or boxes within a category."""
    groups = [other for other in chart.marks if isinstance(other, type(mark))]
    place = next(place for place, other in enumerate(groups) if other is mark)
    width = 0.8 / len(groups)
    return width, (place - (len(groups) - 1) / 2) * width


def _cells(axes: Any, mark: Cells, _chart: Chart) -> None:
    ends = mark.span or (None, None)
    norm = mpl.colors.LogNorm(*ends) if mark.log else mpl.colors.Normalize(*ends)
    colours = "viridis_r" if mark.lower_is_better else "viridis"
    image = axes.imshow(mark.values, cmap=colours, norm=norm, aspect="auto", origin="lower")
    beside = EngFormatter(unit="B") if mark.unit == "bytes" else None
    axes.get_figure().colorbar(image, ax=axes, label=plain(titled(mark.label, mark.unit)), format=beside)
    axes.grid(visible=False)
    # As large as the longest line allows.
    longest = max((len(line) for row in mark.texts for text in row for line in text.split("\n")), default=0)
    axes_points = float(axes.bbox.width * 72 / axes.get_figure().dpi)
    cell_points: float = axes_points * _MAP_SHARE / mark.values.shape[1]
    points = min(_LARGEST_CELL_TEXT, max(_SMALLEST_CELL_TEXT, cell_points / (_LETTER_WIDTH * max(longest, 1))))
    for row, texts in enumerate(mark.texts):
        for column, text in enumerate(texts):
            value = mark.values[row, column]
            dark = bool(np.isfinite(value) and np.mean(image.cmap(image.norm(value))[:3]) < 0.5)
            axes.text(
                column,
                row,
                "\n".join(map(plain, text.split("\n"))),
                ha="center",
                va="center",
                fontsize=points,
                color="white" if dark else "black",
            )


def _segments(axes: Any, mark: Segments, _chart: Chart) -> None:
    label = {"label": plain(mark.name)} if mark.name else {}
    style = {"linestyle": "--"} if mark.dashed else {}
    for x0, y0, x1, y1 in zip(mark.x0, mark.y0, mark.x1, mark.y1, strict=True):
        axes.plot([x0, x1], [y0, y1], color=_colour(mark.colour), linewidth=mark.width, **style, **label)
        label = {}


def _labels(axes: Any, mark: Labels, _chart: Chart) -> None:
    side = {"left": "left", "right": "right", "centre": "center"}[mark.anchor]
    vertical = "bottom" if mark.anchor == "centre" else "center"
    for x, y, text in zip(mark.x, mark.y, mark.texts, strict=True):
        axes.text(x, y, plain(text), ha=side, va=vertical, fontsize=7, in_layout=False)


def _parallel(axes: Any, mark: Parallel, _chart: Chart) -> None:
    places = np.arange(len(mark.dimensions))
    rows = np.stack([_unit(dimension.values) for dimension in mark.dimensions], axis=1)
    spread = mpl.colors.LogNorm if mark.shade_axis.log else mpl.colors.Normalize
    shades = spread(np.nanmin(mark.shades), np.nanmax(mark.shades))
    colours = mpl.colormaps["viridis"]
    for row, shade in zip(rows, mark.shades, strict=True):
        axes.plot(places, row, color=colours(shades(shade)), linewidth=0.6, alpha=0.6)
    axes.set_xticks(places, [plain(dimension.axis.title) for dimension in mark.dimensions], rotation=20, ha="right")
    axes.set_yticks([])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.margins(x=0.08)
    behind = {"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 0.8}
    for place, dimension in zip(places, mark.dimensions, strict=True):
        axes.axvline(place, color="#7b838c", linewidth=0.8)
        for height, text in _ends(dimension.values, dimension.axis.categories):
            axes.text(place, height, text, fontsize=6, ha="center", va="center", bbox=behind)
    axes.get_figure().colorbar(mpl.cm.ScalarMappable(shades, colours), ax=axes, label=plain(mark.shade_axis.title))


def _unit(values: Array) -> Array:
    low, high = np.nanmin(values), np.nanmax(values)
    return (values - low) / (high - low) if high > low else np.full(len(values), 0.5)


def _ends(values: Array, categories: tuple[str, ...] | None) -> list[tuple[float, str]]:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if categories is not None:
        span = (high - low) or 1.0
        return [((place - low) / span, plain(name)) for place, name in enumerate(categories) if low <= place <= high]
    return [(0.0, f"{low:.3g}"), (1.0, f"{high:.3g}")] if high > low else [(0.5, f"{low:.3g}")]


def _colour(colour: str) -> str:
    return _REFERENCE_COLOUR if colour == REFERENCE else colour


_DRAWN_BY: dict[type[Any], Callable[[Any, Any, Chart], None]] = {
    Points: _points,
    Line: _line,
    Bars: _bars,
    Boxes: _boxes,
    Cells: _cells,
    Density: _density,
    Segments: _segments,
    Labels: _labels,
    Parallel: _parallel,
}


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
        """Number of letters that fit, if ``default`` fit into a plot with title and caption."""
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
        # Rounded, as the last digits of the layout solver are random.
        engine = figure.get_layout_engine()
        assert engine is not None, "set by the caller"
        engine.execute(figure)
        figure.set_layout_engine("none")
        for part in figure.subfigs:  # they contain legends and titles
            part.bbox_relative.set_points(np.round(part.bbox_relative.get_points(), 9))
        for axes in figure.axes:
            left, bottom, width, height = (round(value, 9) for value in axes.get_position(original=True).bounds)
            axes.set_position((left, bottom, width, height))
        buffer = io.BytesIO()
        metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(file_format)
        figure.savefig(buffer, format=file_format, dpi=DOTS_PER_INCH, metadata=metadata)
    if file_format != "svg":
        return buffer.getvalue()
    # The clipping areas get numbers: matplotlib names them by a hash of all digits of their coordinates.
    names: dict[bytes, bytes] = {}
    return _CLIP_NAME.sub(lambda found: names.setdefault(found[0], b"clip%d" % len(names)), buffer.getvalue())


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
    labels = plot.axes[-1].xaxis.get_tightbbox()
    boxes = [legend.get_window_extent() for legend in plot.legends] + ([] if labels is None else [labels])
    # The legend, and the labels below the lowest axes, come on top of the height of the plot.
    around_inches = float(sum(box.height for box in boxes)) / figure.dpi
    figure.set_size_inches(sheet.width, sheet.height * chart.height + around_inches)
    return figure


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
    if chart.bare:
        axes.set_axis_off()
        axes.margins(x=chart.bare_margin(sheet.letters(140)), y=0.12)  # labels beside the lines
    else:
        for name, axis in (("x", chart.x), ("y", chart.y), ("z", chart.z)):
            if axis is not None:
                _dress_axis(axes, name, axis, sheet)
        if chart.equal_aspect:
            axes.set_aspect("equal", **({} if chart.z is not None else {"adjustable": "datalim"}))
    if band is not None:
        draw_failed(band, chart)
    handles, labels = axes.get_legend_handles_labels()
    if 1 < len(labels) <= _LEGEND_MOST:
        columns = max(1, min(6, int(sheet.letters(100 if sheet.worded else 130) // (max(map(len, labels)) + 5))))
        tight = {} if sheet.worded else {"columnspacing": 1.0, "handlelength": 1.4, "labelspacing": 0.3}
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=7, frameon=False, **tight)


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
        drawn.set_major_formatter(EngFormatter(unit="B"))


_MOST_FINE_SPAN = 200
"""A logarithmic axis over a larger factor has labels at powers of ten only."""
_MOST_LOG_LABELS = 8
_PLAIN: Any = FuncFormatter(lambda value, _place: f"{value:g}")
