"""Accuracy by attribute of the datasets: other groups than datasets in two plot types."""

from __future__ import annotations

import pandas as pd
import pytest

from slamhive.analysis.chart import Bars, Boxes
from slamhive.analysis.plot_types import PLOT_TYPES, PlotData
from slamhive.analysis.report import PlotResult
from slamhive.analysis.table import NOT_STATED, RunTable, make_table
from slamhive.base.errors import InvalidInput, NotFound
from tests.analysis.analysis_world import NoFiles

pytestmark = pytest.mark.quick

ATTRIBUTES = {"hall": ("indoor", "easy"), "street": ("outdoor", "difficult"), "both": ("indoor", "outdoor"), "desk": ()}


def test_cpu_models_are_not_mixed_in_silence() -> None:
    shown = table()
    assert shown.cpu_words == ""
    for hosts, words in (
        (["Xeon", "Xeon", None, "Xeon", "Xeon"], ""),
        (["EPYC", "Xeon", None, "Xeon", "Xeon"], "Several CPU models together: Xeon (3 runs), EPYC (1 run)."),
    ):
        mixed = shown.with_rows(shown.frame.assign(host=hosts))
        assert mixed.cpu_words == words
        caption = build("by_algorithm", mixed, metric="ate.rmse", by="dataset").charts[0].caption
        assert ("Several CPU models" in caption) == bool(words)


def table(**parameters: list[object]) -> RunTable:
    datasets = [*ATTRIBUTES, "hall"]
    facts: dict[str, list[object]] = {
        "run_id": [1, 2, 3, 4, 5],
        "configuration_id": [1, 2, 3, 4, 1],
        "algorithm": ["kiss-icp"] * 5,
        "dataset": list(datasets),
        "state": [*["succeeded"] * 4, "failed"],
        "evaluation": ["succeeded"] * 5,
    }
    errors_m = {"ate.rmse": [0.1, 0.2, 0.3, 0.4, None]}
    return make_table(facts, parameters, errors_m, attributes=[ATTRIBUTES[name] for name in datasets])


def build(key: str, shown: RunTable, **options: object) -> PlotResult:
    plot_type = PLOT_TYPES.get(key)
    return plot_type.build(PlotData(shown, pd.DataFrame(), NoFiles()), plot_type.options(**options))


@pytest.mark.parametrize("key", ["by_algorithm", "distributions"])
def test_runs_are_grouped_by_a_property_of_their_datasets(key: str) -> None:
    metric = {"metric": "ate.rmse"} if key == "by_algorithm" else {"metrics": ["ate.rmse"]}
    chart = build(key, table(), by="place", **metric).charts[0]
    assert chart.x.title == "Place"
    assert chart.x.categories == ("indoor", "indoor + outdoor", NOT_STATED, "outdoor")
    (mark,) = (mark for mark in chart.marks if isinstance(mark, Bars | Boxes))
    if isinstance(mark, Bars):
        assert mark.heights.tolist() == [0.1, 0.3, 0.4, 0.2]
    else:
        assert mark.categories == ("indoor", "outdoor", "indoor + outdoor", NOT_STATED)


def test_the_summary_has_a_row_for_each_group() -> None:
    summary = build("by_algorithm", table(), by="difficulty").tables[0]
    assert [row[:4] for row in summary.rows] == [
        ("kiss-icp", "difficult", 1, 0),
        ("kiss-icp", "easy", 2, 1),
        ("kiss-icp", NOT_STATED, 2, 0),
    ]


def test_without_the_option_nothing_changes() -> None:
    assert build("distributions", table(), metrics=["ate.rmse"]).charts[0].x.categories == tuple(sorted(ATTRIBUTES))


def test_parameters_group_too() -> None:
    chart = build("by_algorithm", table(rate=[1.0, 1.0, 2.5, 2.5, 1.0]), by="rate").charts[0]
    assert chart.x.categories == ("1", "2.5")


def test_a_parameter_keeps_its_name() -> None:
    shown = table(motion=[1.0, 2.0, 3.0, 4.0, 5.0])
    assert shown.column("motion").numeric
    assert shown.frame["motion"].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]


def test_what_cannot_group() -> None:
    with pytest.raises(InvalidInput, match=r"runs cannot be grouped by the metric ate\.rmse"):
        build("by_algorithm", table(), by="ate.rmse")
    with pytest.raises(NotFound, match="'dificulty'; did you mean 'difficulty'"):
        build("by_algorithm", table(), by="dificulty")


@pytest.mark.integration
def test_kinds_of_trajectories_are_not_mixed_in_silence() -> None:
    labels = ["SE(3), association 0.01 s"] * 5
    for kinds, words in (
        (["final"] * 5, ""),
        (["final", None, "final", None, None], ""),
        (
            ["live", "final", None, "live", "live"],
            "Several kinds of trajectories together: final of kiss-icp; live of kiss-icp.",
        ),
    ):
        shown = table()
        rows = shown.frame.assign(trajectory=kinds, protocol_label=labels)
        mixed = shown.with_rows(rows)
        assert mixed.trajectory_words == words
        caption = build("by_algorithm", mixed, metric="ate.rmse", by="dataset").charts[0].caption
        assert ("Several kinds of trajectories" in caption) == bool(words)
        named = mixed.with_rows(rows.assign(protocol_label=[f"{label}, live trajectory" for label in labels]))
        assert named.trajectory_words == ""
