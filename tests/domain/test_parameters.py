from __future__ import annotations

from dataclasses import replace

import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.parameters import Parameter, ParameterType, Value, check_stored, find_parameter, parse_settings

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


@pytest.mark.parametrize("value", [1.01, 2.0, 1.1, 4 / 3, 1.0100000000000002, 1.9999999999999998])
def test_a_float_survives_its_text(value):
    assert SCALE.parse(repr(value)) == value


GENERAL = Parameter("nFeatures", ParameterType.INT, 1200, "", minimum=100, general="features")
OTHER = Parameter("features_per_cell", ParameterType.INT, 5, "")


def test_a_parameter_has_two_names():
    for name in ("nFeatures", "features"):
        assert find_parameter((OTHER, GENERAL), name) is GENERAL
        assert parse_settings("orb", (GENERAL,), {name: "900"}) == {"nFeatures": 900}
    assert find_parameter((GENERAL,), "feature") is None
    with pytest.raises(NotFound, match="did you mean 'features'"):
        parse_settings("orb", (GENERAL,), {"feature": 1})
    with pytest.raises(InvalidInput, match="features and nFeatures both set nFeatures of orb; give one"):
        parse_settings("orb", (GENERAL,), {"features": 900, "nFeatures": 900})


def test_a_key_wins_over_a_general_name():
    shadow = Parameter("features", ParameterType.INT, 1, "")
    assert find_parameter((GENERAL, shadow), "features") is shadow


EVERY_TYPE = (FEATURES, SCALE, DESKEW, KIND, MATRIX, TEXT)
STORED: dict[str, Value] = {
    "nFeatures": 900,
    "scaleFactor": 1.5,
    "deskew": False,
    "kind": "b",
    "K": (1.0, 2.0),
    "label": "x",
}


def test_stored_values_of_every_type_fit_their_own_definitions():
    check_stored("orb", EVERY_TYPE, STORED)
    check_stored("orb", EVERY_TYPE[::-1], STORED)


@pytest.mark.parametrize(
    "edited",
    [replace(FEATURES, default=5000), replace(FEATURES, unit="points"), replace(FEATURES, help="x", general="features"),
     replace(FEATURES, minimum=900), replace(FEATURES, type=ParameterType.FLOAT)],
)  # fmt: skip
def test_an_edit_that_still_allows_the_value_is_no_matter(edited):
    check_stored("orb", (edited, *EVERY_TYPE[1:]), STORED)


@pytest.mark.parametrize(
    ("definitions", "message"),
    [
        ((replace(FEATURES, minimum=1000), *EVERY_TYPE[1:]), "=900 is stored, orb now wants int, 1000 to 10000"),
        ((replace(FEATURES, type=ParameterType.STRING), *EVERY_TYPE[1:]), "=900 is stored, orb now wants string"),
        ((replace(FEATURES, type=ParameterType.BOOL), *EVERY_TYPE[1:]), "=900 is stored, orb now wants true or"),
        ((*EVERY_TYPE[:2], replace(DESKEW, type=ParameterType.STRING), *EVERY_TYPE[3:]), "deskew=False is stored"),
        ((*EVERY_TYPE[:3], replace(KIND, choices=("a", "c")), *EVERY_TYPE[4:]), "kind='b' is stored, orb now"),
        (EVERY_TYPE[1:], "orb has no parameter 'nFeatures' any more, nFeatures=900 is stored"),
        ((*EVERY_TYPE, OTHER), "orb has a new parameter 'features_per_cell', for which no value is stored"),
    ],
)  # fmt: skip
def test_an_edit_after_which_a_stored_value_does_not_fit_is_named(definitions, message):
    with pytest.raises(InvalidInput) as caught:
        check_stored("orb", definitions, STORED)
    assert message in str(caught.value)
    assert "copy the configuration" in str(caught.value)
