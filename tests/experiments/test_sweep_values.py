from __future__ import annotations

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.parameters import Parameter, ParameterType
from slamhive.experiments.values import check_distinct, parse_values, plain, typed


@pytest.mark.parametrize(
    ("raw", "values"),
    [
        (5, (5,)),
        (True, (True,)),
        ("a | b|c", ("a", "b", "c")),
        ("1 | .8 | 1e-3 | true", (1, 0.8, 0.001, True)),
        ("500:2500:500", (500, 1000, 1500, 2000, 2500)),
        ("1:3", (1, 2, 3)),
        ("3:1:-1", (3, 2, 1)),
        ("0:1:0.1", (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)),
        ("0:10:4", (0, 4, 8)),
        ("lin(0, 1, 5)", (0.0, 0.25, 0.5, 0.75, 1.0)),
        ("lin(0, 100, 3)", (0, 50, 100)),
        ("log(0.001, 1, 4)", (0.001, 0.01, 0.1, 1.0)),
        ("log(1, 1000, 4)", (1, 10, 100, 1000)),
        ("0.5 | 1:2:0.5 | lin(3, 4, 2)", (0.5, 1.0, 1.5, 2.0, 3, 4)),
        ([1, "a|b", "1:2", [1, 2.5]], (1, "a|b", "1:2", (1.0, 2.5))),
        ("12:30 am", ("12:30 am",)),
    ],
)
def test_expressions_stand_for_these_values(raw, values):
    found = parse_values(raw)
    assert found == values
    assert [isinstance(value, int) for value in found] == [isinstance(value, int) for value in values]


def test_steps_of_a_tenth_read_as_one_writes_them():
    assert [str(plain(value)) for value in parse_values("0.1:0.5:0.1 | lin(0.6, 0.9, 4)")] == [
        "0.1", "0.2", "0.3", "0.4", "0.5", "0.6", "0.7", "0.8", "0.9",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ("", "holds an empty value"),
        ("1 | | 2", "holds an empty value"),
        ([], "holds no value"),
        (None, "is not a value"),
        ({"a": 1}, "is not a value"),
        ([[]], "is not a value"),
        ([["a"]], "is not a value"),
        (float("nan"), "not a finite number"),
        ("1:2:0", "never ends"),
        ("1:5:-1", "never ends"),
        ("0:999999999:1", "gives 1,000,000,000 values"),
        ("0:1:1e-300", "values, at most 100,000"),
        ("lin(0, 1, 999999999)", "gives 999,999,999 values"),
        ("lin(0, 1)", "is not understood"),
        ("uniform(0, 1)", "is not understood"),
        ("0.5 .. 5", "0.5 .. 5 is no finite choice; write first:last:step"),
        ("1...5", "is no finite choice"),
        ("exp(0, 1, 3)", "is not understood"),
        ("lin(0, x, 3)", "is not understood"),
        ("lin(0, 1, 1)", "n is 2 or more"),
        ("log(0, 1, 3)", "ends above 0"),
        (["x"] * 100_001, "100,001 values"),
        ("1e308:1e309:1e307", "1e308 is beyond what a range can reach"),
        ("log(1e100, 1e-101, 5)", "1e-101 is beyond what a range can reach"),
    ],
)
def test_nonsense_is_refused_at_once_in_one_line(raw, message):
    with pytest.raises(InvalidInput) as caught:
        parse_values(raw)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_integer_parameter_takes_the_nearest_of_a_computed_value_but_no_written_fraction():
    features = Parameter("nFeatures", ParameterType.INT, 1000, "")
    values = [typed(features, value) for value in parse_values("log(100, 10000, 5)")]
    assert values == [100, 316, 1000, 3162, 10000]
    assert all(type(value) is int for value in values)
    with pytest.raises(InvalidInput, match=r"nFeatures=2\.5"):
        typed(features, 2.5)


def test_computed_values_are_plain_floats_in_the_end():
    (first, *_) = parse_values("lin(0.1, 0.2, 3)")
    assert type(plain(first)) is float
    assert type(typed(Parameter("x", ParameterType.FLOAT, 0.0, ""), first)) is float


def test_a_value_given_twice_is_refused():
    with pytest.raises(InvalidInput, match="5 is given twice"):
        check_distinct(parse_values("1:5 | 5"))
    check_distinct((1, 1.0, True, "1"))


@pytest.mark.parametrize("text", ["1e400", "9" * 4420, "1e999999999:2:1", "0:1:1e-999999999"])
def test_numbers_beyond_all_use_are_text_at_once(text):
    """As exact fractions they would take gigabytes; the parameter that takes the value refuses the text."""
    assert parse_values(text) == (text,)
