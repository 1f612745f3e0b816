"""Which of several runs is better: never on a tie, by chance, for a failed run or without a direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import pytest

from slamhive.domain.run import Host
from slamhive.domain.trust import Trust, TrustLevel
from slamhive.services.run_comparison import (
    ComparedProtocol,
    MetricLine,
    RunColumn,
    Unmarked,
    group_sentences,
    metric_lines,
    setting_lines,
    unmarked_parts,
)

pytestmark = pytest.mark.integration  # scipy takes half a second to load


@dataclass(frozen=True)
class Numbered:
    """What the marks of a comparison need of a run."""

    id: int
    trust: Trust | None = None
    dataset: str = "room"
    host: Host | None = None
    configuration_id: int = 0


def column(*run_ids: int, failed: tuple[int, ...] = (), trust: Trust | None = None) -> RunColumn:
    return RunColumn(cast("Any", tuple(Numbered(run_id, trust) for run_id in run_ids)), failed)


def line_of(key: str, values: dict[int, float], *columns: RunColumn, unmarked: tuple[Unmarked, ...] = ()) -> MetricLine:
    (line,) = metric_lines(columns, {run: {key: value} for run, value in values.items()}, unmarked)
    return line


def parts_of(*runs: Numbered, mixed: bool = False) -> tuple[Unmarked, ...]:
    return unmarked_parts(cast("Any", runs), mixed_trajectories=mixed)


@pytest.mark.parametrize(
    ("key", "values", "best"),
    [
        ("ate.rmse", {1: 0.2, 2: 0.1}, 1),
        ("tracked_fraction", {1: 0.9, 2: 0.8}, 0),
        ("ate.rmse", {1: 0.10001, 2: 0.10002}, None),  # equal in the three digits that are shown
        ("scale", {1: 1.0, 2: 1.2}, None),  # neutral
    ],
)
def test_the_better_single_run_is_marked(key: str, values: dict[int, float], best: int | None):
    assert line_of(key, values, column(1), column(2)).best == best


def test_a_value_alone_is_not_better_than_nothing():
    values = {1: {"ate.rmse": 0.2}, 2: {}}
    (line,) = metric_lines((column(1), column(2)), values)
    assert (line.figures[1], line.best) == (None, None)


def test_a_failed_run_is_shown_and_never_marked():
    line = line_of("ate.rmse", {1: 0.01, 2: 0.3, 3: 0.2}, column(1, failed=(1,)), column(2), column(3))
    assert line.figures[0] is not None
    assert line.best == 2


def test_a_run_with_low_trust_is_never_marked():
    low = Trust(TrustLevel.LOW)
    line = line_of("ate.rmse", {1: 0.01, 2: 0.3, 3: 0.2}, column(1, trust=low), column(2), column(3))
    assert line.best == 2
    assert line_of("ate.rmse", {1: 0.01, 2: 0.3}, column(1, trust=low), column(2)).best is None
    limited = Trust(TrustLevel.LIMITED)
    assert line_of("ate.rmse", {1: 0.01, 2: 0.3}, column(1, trust=limited), column(2)).best == 0


@pytest.mark.parametrize(
    "key", ["disturbance.others_cores", "playback.lag_max", "cpu.player_mean", "poses", "ate.sse", "ate.over_repeats"]
)
def test_what_says_nothing_of_the_algorithm_is_never_marked(key: str):
    assert line_of(key, {1: 1.0, 2: 2.0}, column(1), column(2)).best is None


def test_nothing_is_marked_between_runs_of_several_datasets():
    unmarked = parts_of(Numbered(1), Numbered(2, dataset="kitti"))
    assert [entry.words for entry in unmarked] == ["nothing is marked as better: the runs are of 2 datasets"]
    for key in ("ate.rmse", "cpu.mean"):
        assert line_of(key, {1: 0.2, 2: 0.1}, column(1), column(2), unmarked=unmarked).best is None


def test_errors_of_mixed_trajectories_are_not_marked():
    unmarked = parts_of(Numbered(1), Numbered(2), mixed=True)
    assert line_of("ate.rmse", {1: 0.2, 2: 0.1}, column(1), column(2), unmarked=unmarked).best is None
    assert line_of("cpu.mean", {1: 0.2, 2: 0.1}, column(1), column(2), unmarked=unmarked).best == 1


def test_what_several_processors_measured_is_not_marked():
    one, other = (Host(cpu_model=name, cpu_count=2, memory_bytes=1, kernel="k", os="o") for name in ("A", "B"))
    unmarked = parts_of(Numbered(1, host=one), Numbered(2, host=other), Numbered(3))
    assert [entry.words for entry in unmarked] == [
        "no CPU, memory or time is marked as better: the runs are of 2 CPU models"
    ]
    assert line_of("cpu.mean", {1: 0.2, 2: 0.1}, column(1), column(2), unmarked=unmarked).best is None
    assert line_of("ate.rmse", {1: 0.2, 2: 0.1}, column(1), column(2), unmarked=unmarked).best == 1
    assert parts_of(Numbered(1, host=one), Numbered(2, host=one), Numbered(3)) == ()


def test_a_group_with_one_good_run_is_not_better_than_repeats():
    values = {1: 0.1, 2: 0.5, 3: 0.51}
    assert line_of("ate.rmse", values, column(1, 4, failed=(4,)), column(2, 3)).best is None


def test_repeats_are_marked_only_if_chance_does_not_explain_the_difference():
    apart = {1: 0.10, 2: 0.11, 3: 0.12, 4: 0.50, 5: 0.51, 6: 0.52}
    assert line_of("ate.rmse", apart, column(1, 2, 3), column(4, 5, 6)).best == 0
    near = {1: 0.10, 2: 0.20, 3: 0.30, 4: 0.15, 5: 0.25, 6: 0.35}
    line = line_of("ate.rmse", near, column(1, 2, 3), column(4, 5, 6))
    assert line.best is None
    first = line.figures[0]
    assert first is not None
    assert first.low is not None
    assert first.high is not None
    assert first.count == 3
    assert first.mean == pytest.approx(0.2)
    assert first.low < 0.2 < first.high


def test_the_mean_of_repeats_leaves_failed_runs_out():
    figure = line_of("ate.rmse", {1: 0.1, 2: 0.3, 3: 9.0, 4: 1.0}, column(1, 2, 3, failed=(3,)), column(4)).figures[0]
    assert figure is not None
    assert figure.count == 2
    assert figure.mean == pytest.approx(0.2)


def test_a_sentence_says_how_a_group_stands_to_the_baseline():
    def repeats(configuration: int, *run_ids: int, failed: tuple[int, ...] = ()) -> RunColumn:
        return RunColumn(
            cast("Any", tuple(Numbered(run_id, configuration_id=configuration) for run_id in run_ids)), failed
        )

    errors_m = {1: 0.10, 2: 0.11, 3: 0.12, 4: 0.50, 5: 0.51, 6: 0.52, 7: 0.10, 8: 0.12, 9: 0.13}
    values = {run: {"ate.rmse": error_m} for run, error_m in errors_m.items()}
    columns = repeats(3, 1, 2, 3), repeats(4, 4, 5, 6), repeats(5, 7, 8, 9), repeats(6, 10, 11, failed=(10, 11))
    protocol = ComparedProtocol(fingerprint="f" * 16, label="SE(3)", runs=(), lacking=())
    worse, near, none = group_sentences(columns, values, protocol, 0)
    assert worse == (
        "Configuration 4 is worse than configuration 3: ATE 0.510 ± 0.010 m against 0.110 ± 0.010 m, p < 0.001."
    )
    assert near.startswith("Configuration 5 and configuration 3 are not separated, p = ")
    assert near.endswith(" more repeats would decide.")
    assert none == "Configuration 6 and configuration 3 are not separated, p = 0.1; 1 more repeat would decide."
    better, *_ = group_sentences(columns, values, protocol, 1)
    assert better == (
        "Configuration 3 is better than configuration 4: ATE 0.110 ± 0.010 m against 0.510 ± 0.010 m, p < 0.001."
    )
    assert group_sentences((repeats(3, 1), repeats(4, 4, 5)), values, protocol, 0) == (
        "No test can judge one good run of configuration 3; add 2 repeats.",
    )


def test_settings_of_repeats_list_their_values_and_missing_ones_differ():
    lines = setting_lines([[{"seed": "1", "a": "x"}, {"seed": "2", "a": "x"}], [{"seed": "1", "b": "y"}]])
    assert {line.key: (line.texts, line.differs) for line in lines} == {
        "seed": (("1, 2", "1"), True),
        "a": (("x", None), True),
        "b": ((None, "y"), True),
    }
