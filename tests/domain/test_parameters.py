from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamhive.domain.parameters import Parameter, ParameterType, parse_settings
from slamhive.errors import InvalidInput, NotFound

FEATURES = Parameter("nFeatures", ParameterType.INT, 1200, "How many.", unit="features", minimum=100, maximum=10000)
SCALE = Parameter("scaleFactor", ParameterType.FLOAT, 1.2, "Pyramid.", minimum=1.01, maximum=2.0)
DESKEW = Parameter("deskew", ParameterType.BOOL, True, "Undo motion.")
KIND = Parameter("kind", ParameterType.ENUM, "a", "Kind.", choices=("a", "b"))
MATRIX = Parameter("K", ParameterType.MATRIX, (1.0,), "Numbers.")
TEXT = Parameter("label", ParameterType.STRING, "", "Text.")


@pytest.mark.parametrize(
    ("parameter", "raw", "value"),
    [
        (FEATURES, "2000", 2000),
        (FEATURES, 2000.0, 2000),
        (SCALE, "1.5", 1.5),
        (SCALE, 2, 2.0),
        (DESKEW, "off", False),
        (DESKEW, True, True),
        (KIND, "b", "b"),
        (MATRIX, "[1, 2.5]", (1.0, 2.5)),
        (MATRIX, [1, 2], (1.0, 2.0)),
        (TEXT, "x: #y", "x: #y"),
    ],
)
def test_text_and_yaml_become_typed_values(parameter, raw, value):
    parsed = parameter.parse(raw)
    assert parsed == value
    assert type(parsed) is type(value)


@pytest.mark.parametrize(
    ("parameter", "raw"),
    [
        (FEATURES, "many"),
        (FEATURES, "99"),
        (FEATURES, "10001"),
        (FEATURES, 12.5),
        (FEATURES, True),
        (FEATURES, float("inf")),
        (FEATURES, float("nan")),
        (FEATURES, "1_000"),
        (FEATURES, 10**400),
        (FEATURES, None),
        (SCALE, "1_0.5"),
        (SCALE, 10**400),
        (SCALE, None),
        (SCALE, "nan"),
        (SCALE, "inf"),
        (SCALE, False),
        (DESKEW, "maybe"),
        (KIND, "c"),
        (MATRIX, "1,x"),
        (TEXT, "two\nlines"),
    ],
)
def test_what_does_not_fit_is_refused_naming_key_value_and_expectation(parameter, raw):
    with pytest.raises(InvalidInput) as caught:
        parameter.parse(raw)
    assert f"parameter {parameter.key}={raw!r}"[:200] in str(caught.value) or "x" in str(raw)
    assert parameter.expectation in str(caught.value)
    assert "\n" not in str(caught.value)


def test_expectation_tells_type_range_and_unit():
    assert FEATURES.expectation == "int, 100 to 10000 features"
    assert KIND.expectation == "one of a, b"
    assert DESKEW.expectation == "true or false"
    assert Parameter("n", ParameterType.INT, 1, "", minimum=16, maximum=10_000_000).expectation == "int, 16 to 10000000"
    assert Parameter("f", ParameterType.FLOAT, 1.0, "", minimum=1e-7).expectation == "float, at least 0.0000001"


def test_settings_override_defaults_in_definition_order():
    assert list(parse_settings("x", (FEATURES, SCALE), {"scaleFactor": "1.3"}).items()) == [
        ("nFeatures", 1200),
        ("scaleFactor", 1.3),
    ]


def test_an_unknown_parameter_is_named_with_the_nearest_known_one():
    with pytest.raises(NotFound, match="orb has no parameter 'nFeature'; did you mean 'nFeatures'"):
        parse_settings("orb", (FEATURES,), {"nFeature": "1"})


@given(st.floats(min_value=1.01, max_value=2.0))
def test_a_float_survives_its_text(value):
    assert SCALE.parse(repr(value)) == value
