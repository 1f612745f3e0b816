"""Plots for the columns of a paper, and the colours and markers that are the same everywhere."""

from __future__ import annotations

import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from slamhive.analysis.chart import (
    MARKERS,
    PAPER_FORMATS,
    RUN_COLOURS,
    Axis,
    Cells,
    Chart,
    Line,
    algorithm_colours,
    colour_of,
    contrast,
    marker_of,
    on_dark,
)
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.analysis.print_chart import draw_mark, print_chart

pytestmark = pytest.mark.integration  # matplotlib takes a second to load
INSTALLED = [f"slam{place:02}" for place in range(40)]


def chart(colour: str = "#0072B2") -> Chart:
    values = np.array([0.01, 0.1, 1.0])
    lines = tuple(Line(f"a name of some length {place}", values, values, colour=colour) for place in range(8))
    return Chart("key", "The title", Axis("time", "s"), Axis("error", "m", log=True), lines, "The caption.")


def size_mm(pdf: bytes) -> tuple[float, float]:
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+)", pdf)
    assert box is not None
    return float(box[1]) / 72 * 25.4, float(box[2]) / 72 * 25.4


def test_a_plot_for_a_paper_is_as_wide_as_its_columns_and_has_its_font():
    for ending, width_mm in zip(PAPER_FORMATS, (88, 180), strict=True):
        pdf = print_chart(chart(), ending)
        assert size_mm(pdf)[0] == pytest.approx(width_mm, abs=0.1)
        assert b"STIXGeneral" in pdf
        assert b"/Subtype /Image" not in pdf
    assert b"DejaVuSans" in print_chart(chart(), PAPER_FORMATS[0], "sans")
    assert size_mm(print_chart(chart(), "88mm.pdf"))[1] > 48, "the legend adds its height"


@pytest.mark.parametrize(("columns", "points"), [(3, 9.0), (20, 6.0)])
def test_the_text_in_cells_is_as_large_as_they_allow(columns, points):
    axes = Figure(figsize=(6.4, 4.8)).add_subplot()
    cells = Cells(np.ones((2, columns)), (("0.0107\n1 of 4 failed",) * columns,) * 2, label="ATE RMSE", unit="m")
    draw_mark(axes, cells, chart())
    assert {text.get_fontsize() for text in axes.texts} == {points}


def test_an_algorithm_has_one_colour_wherever_it_appears():
    colours = algorithm_colours(INSTALLED, INSTALLED)
    assert len(set(colours.values())) == len(INSTALLED)
    for name in (INSTALLED[3], INSTALLED[23]):
        assert algorithm_colours([name], INSTALLED)[name] == colour_of(name, INSTALLED) == colours[name]
    assert colour_of("own", INSTALLED) == algorithm_colours(["own", INSTALLED[0]], INSTALLED)["own"]
    assert marker_of(INSTALLED[0], INSTALLED) != marker_of(INSTALLED[20], INSTALLED), "a shade of the same colour"
    assert len(set(MARKERS)) == 12


@pytest.mark.parametrize("colour", RUN_COLOURS)
def test_colours_are_seen_on_dark_pages(colour):
    assert contrast(on_dark(colour), "#212529") >= 3.5
    assert contrast(on_dark("#0072B2"), "#16191c") > contrast("#0072B2", "#16191c")
    found = plotly_figure(chart(colour))["layout"]["meta"]["dark"]
    assert found == ({} if on_dark(colour) == colour else {colour: on_dark(colour)})


def test_a_logarithmic_axis_leaves_the_form_of_its_labels_to_plotly():
    axis = plotly_figure(chart())["layout"]["yaxis"]
    assert (axis["type"], "tickformat" in axis) == ("log", False)
