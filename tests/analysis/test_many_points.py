"""Charts of more points than can be drawn: what is shown stands for all of them."""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest

from slamhive.analysis.chart import (
    DENSITY_FROM,
    SINGLE_MOST,
    SPACE_MOST,
    Axis,
    Chart,
    Density,
    FailedRuns,
    Points,
    rule_words,
    thinned,
)
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.analysis.print_chart import print_chart

pytestmark = pytest.mark.integration

COUNT = 100_000


def cloud(count: int = COUNT, **axes: Axis) -> Chart:
    draws = np.random.default_rng(1)
    half = count // 2
    x, y = draws.normal(0, 1, count), 10 ** draws.normal(-1, 0.5, count)
    runs = np.arange(1, count + 1)
    marks = [
        Points(name, x[part], y[part], colour=colour, runs=runs[part], group=name)
        for name, colour, part in (("a", "#0072B2", slice(half)), ("b", "#D55E00", slice(half, None)))
    ]
    return Chart("c", "t", axes.get("x", Axis("x")), axes.get("y", Axis("y", "m", log=True)), tuple(marks), "")


def test_every_point_is_in_a_cell_or_drawn():
    shown = thinned(cloud())
    densities = [mark for mark in shown.marks if isinstance(mark, Density)]
    singles = [mark for mark in shown.marks if isinstance(mark, Points)]
    assert [mark.name for mark in densities] == ["a", "b"]
    drawn = sum(len(mark.x) for mark in singles)
    assert 0 < drawn <= SINGLE_MOST
    assert sum(int(mark.counts.sum()) for mark in densities) + drawn == COUNT


def test_those_drawn_lie_apart():
    chart = cloud()
    x, y = (np.concatenate([getattr(mark, axis) for mark in chart.marks]) for axis in "xy")
    singles = [mark for mark in thinned(chart).marks if isinstance(mark, Points)]
    extremes = np.concatenate([mark.runs for mark in singles if mark.runs is not None])
    for row in (x.argmin(), x.argmax(), y.argmin(), y.argmax()):
        assert row + 1 in extremes


def test_few_points_are_all_drawn():
    chart = cloud(DENSITY_FROM)
    assert thinned(chart) == chart
    assert rule_words(DENSITY_FROM) == ""
    assert "shades show the number of runs" in rule_words(DENSITY_FROM + 1)


def test_the_page_gets_every_point_for_zooming_and_stays_small():
    figure = plotly_figure(cloud())
    text = json.dumps(figure)
    assert len(text) < 5_000_000
    zoom = figure["zoom"]
    assert [figure["data"][zoom["first"] + place]["name"] for place in range(2)] == ["a", "b"]
    assert all(trace["type"] == "heatmap" for trace in figure["data"][: zoom["first"]])
    runs = [np.frombuffer(base64.b64decode(part["runs"]["bdata"]), "<i4") for part in zoom["points"]]
    assert np.concatenate(runs).tolist() == list(range(1, COUNT + 1))
    assert not any(trace["type"] == "scattergl" for trace in figure["data"])


def test_categories_keep_their_places():
    chart = cloud()
    names = ("one", "two", "three")
    marks = tuple(
        Points(mark.name, np.arange(len(mark.x)) % 3, mark.y, runs=mark.runs, group=mark.name)
        for mark in chart.marks
        if isinstance(mark, Points)
    )
    figure = plotly_figure(Chart("c", "t", Axis("x", categories=names), chart.y, marks, ""))
    axis = figure["layout"]["xaxis"]
    assert axis["ticktext"] == list(names)
    assert axis["tickvals"] == [0, 1, 2]


def test_failed_runs_that_coincide_are_drawn_once_and_all_counted():
    failed = FailedRuns(np.repeat([1.0, 2.0], COUNT // 2), np.arange(COUNT))
    chart = Chart("c", "t", Axis("x"), Axis("y"), (failed,), "")
    (shown,) = (mark for mark in thinned(chart).marks if isinstance(mark, FailedRuns))
    assert len(shown.x) <= 20
    assert set(shown.x) == {1.0, 2.0}
    assert plotly_figure(chart)["layout"]["yaxis2"]["ticktext"] == [f"{COUNT} failed"]


def test_space_holds_a_share_and_says_which():
    draws = np.random.default_rng(0).normal(size=(3, COUNT))
    chart = Chart("c", "t", Axis("x"), Axis("y"), (Points("a", *draws),), "", z=Axis("z"))
    (shown,) = (mark for mark in thinned(chart).marks if isinstance(mark, Points))
    assert len(shown.x) == SPACE_MOST
    assert rule_words(COUNT, space=True) == "The plot shows one of 5 points."


def test_it_prints():
    assert len(print_chart(cloud(), "pdf")) < 1_000_000
