"""Reports and plots as JSON, so that a plot can be drawn again long after it was computed."""

from __future__ import annotations

import json
from typing import Any, get_args

import numpy as np
import pytest

from slamhive.analysis.chart import (
    Axis,
    Bars,
    Boxes,
    Cells,
    Chart,
    Density,
    Dimension,
    FailedRuns,
    Labels,
    Line,
    Mark,
    Parallel,
    Points,
    Segments,
)
from slamhive.analysis.report import Exclusion, PlotResult, ResultTable, TableColumn
from slamhive.base.errors import InvalidInput
from slamhive.documents.model import dump, load

NUMBERS, RUNS = np.array([0.5, np.nan]), np.array([1, 2])
AXIS = Axis("x", "m", categories=("a", "b"))
MARKS: tuple[Mark, ...] = (
    Points("points", NUMBERS, NUMBERS, runs=RUNS, texts=("a", "b")),
    FailedRuns(NUMBERS, RUNS),
    Line("line", NUMBERS, NUMBERS, low=NUMBERS),
    Bars("bars", NUMBERS, colours=("red",)),
    Boxes("boxes", ("a", "b"), NUMBERS),
    Cells(np.eye(2), (("a", "b"), ("c", "d")), "cells", span=(0.0, 1.0)),
    Density("density", NUMBERS, NUMBERS, np.eye(2), 3),
    Segments(NUMBERS, NUMBERS, NUMBERS, NUMBERS),
    Labels(NUMBERS, NUMBERS, ("a", "b")),
    Parallel((Dimension(AXIS, NUMBERS),), NUMBERS, AXIS, RUNS),
)
TABLE = ResultTable(
    "key", "Title", (TableColumn("a", "A"), TableColumn("b", "B")), ((1, 1.0), ("1", True), (None, np.float64(0.5)))
)
RESULT = PlotResult(
    (Chart("key", "Title", AXIS, Axis("y"), MARKS, "caption"),), (TABLE,), 3, 1, (Exclusion("r", (1,)),)
)


def test_every_kind_of_mark_is_read_as_it_was_written():
    assert {type(mark) for mark in MARKS} == set(get_args(Mark))
    text = json.dumps(dump(PlotResult, RESULT))
    found = load(PlotResult, json.loads(text))
    assert [type(mark) for mark in found.charts[0].marks] == [type(mark) for mark in MARKS]
    assert json.dumps(dump(PlotResult, found)) == text
    assert found.tables == (TABLE,)
    points = found.charts[0].marks[0]
    assert isinstance(points, Points)
    assert np.array_equal(points.y, NUMBERS, equal_nan=True)
    assert points.runs is not None
    assert points.runs.dtype == np.int64


def test_the_names_of_version_0_1_are_kept():
    content = dump(PlotResult, RESULT)
    assert content["is"] == "FormResult"
    assert list(content["charts"][0]["marks"][0])[:2] == ["is", "name"]
    assert content["charts"][0]["marks"][0]["x"]["is"] == "array"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"is": "Nothing"}, "charts.0.marks.0"),
        ({"x": {"is": "array", "dtype": "<f8", "shape": [2], "data": "AA"}}, "charts.0.marks.0.*x"),
        ({"x": {"is": "array", "shape": [2], "data": ""}}, "no array: KeyError"),
        ({"texts": [1]}, "texts.0: must be text"),
    ],
)
def test_a_damaged_result_is_refused_and_says_where(change: dict[str, Any], words: str):
    content = dump(PlotResult, RESULT)
    content["charts"][0]["marks"][0].update(change)
    with pytest.raises(InvalidInput, match=words):
        load(PlotResult, content)
