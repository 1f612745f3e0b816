"""No form ranks an algorithm by the runs that survived, and failed runs are seen beside every mean."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from slamhive.analysis.chart import Bars, FailedRuns
from slamhive.analysis.plot_types import PLOT_TYPES, PlotData
from slamhive.analysis.plot_types.by_algorithm import best_configurations
from slamhive.analysis.plot_types.critical_difference import _scores
from slamhive.analysis.plot_types.scatter import configuration_means, fronts_by_dataset
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.analysis.table import RunTable, make_table
from tests.analysis.analysis_world import NoFiles

pytestmark = pytest.mark.integration  # plotting and statistics take seconds to load

DATASETS = ("a", "b", "c")
LUCKY, SOLID = "lucky", "solid"


def table() -> RunTable:
    """On each dataset ``lucky`` has one excellent run of five and four that failed, ``solid`` five that are fair."""
    rows = [(name, data, repeat) for data in DATASETS for name in (LUCKY, SOLID) for repeat in range(5)]
    algorithm, dataset, repeat = map(list, zip(*rows, strict=True))
    failed = [name == LUCKY and place > 0 for name, place in zip(algorithm, repeat, strict=True)]
    facts: dict[str, list[Any]] = {
        "run_id": list(range(1, len(rows) + 1)),
        "configuration_id": [1 + (name == SOLID) for name in algorithm],
        "algorithm": algorithm,
        "dataset": dataset,
        "state": ["failed" if bad else "succeeded" for bad in failed],
        "reason": ["timeout" if bad else None for bad in failed],
        "protocol": [None if bad else "p" for bad in failed],
        "protocol_label": [None if bad else "SE(3)" for bad in failed],
    }
    errors_m = [
        None if bad else 0.01 if name == LUCKY else 0.1 + 0.01 * place**2
        for (name, _, place), bad in zip(rows, failed, strict=True)
    ]
    return make_table(facts, {}, {"ate.rmse": errors_m, "cpu.mean": [1.0] * len(rows)})


def built(form: str, **options: Any) -> Any:
    data = PlotData(table(), pd.DataFrame(), NoFiles())
    chosen = PLOT_TYPES.get(form)
    return chosen.build(data, chosen.options(**options))


def test_critical_differences_give_failed_runs_the_worst_rank_and_keep_their_datasets() -> None:
    failing = table()
    names, blocks, scores = _scores(
        failing.with_rows(failing.frame.assign(competitor=failing.frame["algorithm"])), "ate.rmse"
    )
    assert (names, blocks) == ([LUCKY, SOLID], list(DATASETS))
    # of ten runs the best, and four that share the last four places
    assert scores[0] == pytest.approx([(1 + 4 * 8.5) / 5, (2 + 3 + 4 + 5 + 6) / 5])
    assert (scores[:, 0] > scores[:, 1]).all()


def test_a_dataset_on_which_all_runs_of_one_failed_counts() -> None:
    failing = table()
    frame = failing.frame.assign(competitor=failing.frame["algorithm"])
    frame.loc[(frame["dataset"] == "a") & (frame["algorithm"] == LUCKY), "failed"] = "timeout"
    _, blocks, scores = _scores(failing.with_rows(frame), "ate.rmse")
    assert blocks == list(DATASETS)
    assert list(scores[0]) == [8.0, 3.0]


def test_a_front_is_not_made_by_survivors() -> None:
    means = configuration_means(table(), ["cpu.mean", "ate.rmse"])
    front = fronts_by_dataset(means, ["cpu.mean", "ate.rmse"], np.ones(2))
    assert set(means[front]["algorithm"]) == {LUCKY, SOLID}
    result = built("pareto", metrics=["cpu.mean", "ate.rmse"])
    assert (
        "no other on the same dataset beats in CPU mean, ATE RMSE, the share of failed runs" in result.charts[0].caption
    )


def test_the_selector_ranks_those_that_fail_less_first() -> None:
    result = built("selector", bounds=["ate.rmse < 1"], kept_share=0.1)
    ranking = next(entry for entry in result.tables if entry.key == "ranking")
    assert [row[1] for row in ranking.rows] == [SOLID, LUCKY]


def test_bars_show_failed_runs_in_a_band_and_medians() -> None:
    chart = built("by_algorithm").charts[0]
    marked = {mark.name: len(mark.runs) for mark in chart.marks if isinstance(mark, FailedRuns)}
    assert marked == {f"{LUCKY}, failed": 12}
    medians = {
        mark.name: list(mark.medians) for mark in chart.marks if isinstance(mark, Bars) and mark.medians is not None
    }
    assert medians[SOLID] == pytest.approx([0.14] * 3)
    drawn = [trace for trace in plotly_figure(chart)["data"] if trace["type"] == "bar"]
    assert {trace["offsetgroup"] for trace in drawn} == {LUCKY, SOLID}
    assert len(drawn) == 4


def test_an_algorithm_that_always_fails_stays_in_the_table_of_the_best() -> None:
    failing = table()
    frame = failing.frame.assign(failed=[{LUCKY: "timeout"}.get(name) for name in failing.frame["algorithm"]])
    best = best_configurations(failing.with_rows(frame), "ate.rmse")
    assert set(best) == {(name, data) for name in (LUCKY, SOLID) for data in DATASETS}


def test_one_configuration_under_two_limits_is_two_on_a_front_and_among_the_best() -> None:
    cores = [0.5, 0.5, 1.0, 1.0, None, None]
    limited = make_table(
        {
            "run_id": [1, 2, 3, 4, 5, 6],
            "configuration_id": [1] * 6,
            "algorithm": [SOLID] * 6,
            "dataset": ["a"] * 6,
            "state": ["succeeded"] * 6,
            "reason": [None] * 6,
            "protocol": ["aaaaaaaaaaaa"] * 6,
            "protocol_label": ["SE(3)"] * 6,
            "cpu_cores": cores,
        },
        {},
        {"ate.rmse": [0.4, 0.2, 0.1, 0.1, 0.2, 0.2], "cpu.mean": [0.5, 0.5, 0.9, 0.9, 1.5, 1.5]},
    )
    means = configuration_means(limited, ["cpu.mean", "ate.rmse"])
    half, one, free = "CPU limit 0.5 cores", "CPU limit 1 cores", "CPU limit none stated"
    assert dict(zip(means["under_limits"], means["ate.rmse"], strict=True)) == pytest.approx(
        {half: 0.3, one: 0.1, free: 0.2}
    )
    assert best_configurations(limited, "ate.rmse") == {(SOLID, "a"): (1, one)}
    data = PlotData(limited, pd.DataFrame(), NoFiles())
    kind: Any = PLOT_TYPES.get("by_algorithm")
    result = kind.build(data, kind.options(of="best"))
    (best,) = next(entry for entry in result.tables if entry.key == "best").rows
    assert "cpu_cores 1" in best
    assert "over 2 runs" in result.charts[0].caption
    front = PLOT_TYPES.get("pareto").build(data, PLOT_TYPES.get("pareto").options()).tables[0]
    assert [row[3] for row in front.rows] == [half, one]
