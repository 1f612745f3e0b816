"""Margins, budgets and answers of gates."""

from __future__ import annotations

import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.gate import DEFAULT_MARGINS, FAILURES, Answer, Margin, chosen_margins
from slamhive.domain.question import RunBudget, read_budget

MEASURED = frozenset({"ate.rmse", "tracked.path", "cpu.per_data_second", "cpu.mean", "ram.max", "latency.p95"})


def test_the_defaults_cover_error_tracking_cpu_memory_latency_and_failures():
    assert chosen_margins((), MEASURED) == DEFAULT_MARGINS


def test_a_metric_without_values_is_replaced_or_left_out():
    assert set(chosen_margins((), {"ate.rmse", "cpu.mean"})) == {FAILURES, "ate.rmse", "cpu.mean"}
    assert chosen_margins((), {"cpu.mean"})["cpu.mean"] == DEFAULT_MARGINS["cpu.per_data_second"]


@pytest.mark.parametrize(
    ("text", "key", "margin"),
    [
        ("ate.rmse=5%", "ate.rmse", Margin(0.05)),
        ("ate.rmse = 2.5 %", "ate.rmse", Margin(0.025)),
        ("ate.rmse=0.01", "ate.rmse", Margin(0.01, relative=False)),
        ("cpu.mean=20%", "cpu.mean", Margin(0.2)),
        ("failures=10%", FAILURES, Margin(0.1, relative=False)),
    ],
)
def test_a_margin_is_a_share_or_in_the_unit_of_the_metric(text: str, key: str, margin: Margin):
    assert chosen_margins((text,), MEASURED)[key] == margin


def test_a_margin_can_be_off():
    assert "ram.max" not in chosen_margins(("ram.max=off", "latency.median=off"), MEASURED)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (("ate.rmse",), "write METRIC=MARGIN"),
        (("ate.rmse=-5%",), "margin '-5%' of ate.rmse is not allowed"),
        (("ate.rmse=nan",), "margin 'nan' of ate.rmse is not allowed"),
        (("ate.repeats_limit=5%",), "no direction of it is better"),
        (("rpe.rmse=5%",), "the baseline has no values of rpe.rmse"),
        (tuple(f"{key}=off" for key in DEFAULT_MARGINS), "no metric is left"),
    ],
)
def test_a_margin_that_cannot_be_used_is_refused(texts: tuple[str, ...], message: str):
    with pytest.raises(InvalidInput, match=message):
        chosen_margins(texts, MEASURED)


def test_an_unknown_metric_names_the_nearest():
    with pytest.raises(NotFound, match=r"did you mean 'ate\.rmse'"):
        chosen_margins(("ate.rsme=5%",), MEASURED)


@pytest.mark.parametrize(
    ("text", "budget"),
    [
        ("20 runs", RunBudget(runs=20)),
        ("1run", RunBudget(runs=1)),
        ("30 min", RunBudget(time_s=1800.0)),
        ("1.5h", RunBudget(time_s=5400.0)),
    ],
)
def test_a_budget_is_a_number_of_runs_or_a_time(text: str, budget: RunBudget):
    assert read_budget(text) == budget


@pytest.mark.parametrize("text", ["", "20", "runs", "0 runs", "1.5 runs", "99999 runs", "2 days", "0 min", "-1 h"])
def test_another_budget_is_refused(text: str):
    with pytest.raises(InvalidInput, match="for example '20 runs'"):
        read_budget(text)


def test_a_budget_says_how_many_runs_are_left():
    assert RunBudget(runs=20).runs_left(15, 999.0) == 5
    assert RunBudget(runs=20).runs_left(25, 999.0) == 0
    assert RunBudget(time_s=60.0).runs_left(10, 40.0) == 5  # 4 s each
    assert RunBudget(time_s=60.0).runs_left(10, 70.0) == 0


@pytest.mark.parametrize(
    ("answers", "overall"),
    [
        ([Answer.PASS, Answer.PASS], Answer.PASS),
        ([Answer.PASS, Answer.UNDECIDED], Answer.UNDECIDED),
        ([Answer.UNDECIDED, Answer.WORSE, Answer.PASS], Answer.WORSE),
        ([], Answer.UNDECIDED),
    ],
)
def test_all_have_to_pass_and_one_that_is_worse_decides(answers: list[Answer], overall: Answer):
    assert Answer.over(answers) is overall
