from __future__ import annotations

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.parameters import Value
from slamhive.experiments.condition import compared_names, parse_condition

CONTEXT: dict[str, Value] = {
    "image_rate": 5.0,
    "algorithm": "kiss-icp",
    "dataset": "room",
    "deskew": True,
    "features": 1000,
}
KNOWN = frozenset({*CONTEXT, "voxel"})


def decide(text: str):
    return parse_condition(text).decide(CONTEXT, KNOWN)


@pytest.mark.parametrize(
    ("text", "verdict"),
    [
        ("image_rate >= 2", True),
        ("image_rate > 5", False),
        ("image_rate == 5", True),
        ("image_rate != 5", False),
        ("image_rate < 5.5 and features <= 1e3", True),
        ("algorithm == kiss-icp", True),
        ("algorithm == 'kiss-icp'", True),
        ("dataset in [MH_01, room]", True),
        ("dataset in [MH_01]", False),
        ("not dataset == room", False),
        ("not (image_rate > 5 or features > 2000)", True),
        ("image_rate > 5 or not image_rate > 5", True),
        ("image_rate > 9 and features > 9 or deskew == true", True),
        ("image_rate > 9 and (features > 9 or deskew == true)", False),
        ("dataset != 5", True),
        ("deskew == yes", False),
        ("voxel > 1", None),
        ("not voxel > 1", None),
        ("voxel > 1 or image_rate == 5", True),
        ("voxel > 1 and image_rate == 5", None),
        ("voxel > 1 and image_rate == 6", False),
        ("image_rate < features", True),
        ("image_rate < voxel", None),
        ("image_rate == -5", False),
        ("image_rate => 5 and features = 1000", True),
        ("image_rate between 2 and 5", True),
        ("image_rate between features and 9", False),
        ("image_rate between 2 and voxel", None),
        ("dataset in (MH_01, room)", True),
        ("algorithm not in (kiss-icp, rko-lio)", False),
        ("voxel not in (1, 2)", None),
        ("dataset ~ ro*", True),
        ("dataset !~ ro*", False),
        ("image_rate = voxel", None),
        ("has image_rate and missing voxel", True),
        ("missing voxel or voxel > 1", True),
        ('dataset = "room"', True),
        ("dataset = 'dataset'", False),
    ],
)
def test_conditions_mean_what_they_say(text, verdict):
    assert decide(text) is verdict


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the condition is empty"),
        ("image_rate", "has its end where one of = != < <= > >= ~ !~ in between belongs"),
        ("image_rate >=", "has its end where a value belongs"),
        ("5 > image_rate", "'5' stands where a name belongs"),
        ("(image_rate > 5", "where ')' belongs"),
        ("image_rate > 5 features > 2", "has 'features' where 'and', 'or' or the end belongs"),
        ("image_rate > 5 and", "has its end"),
        ("__import__('os').system('x')", "has '(' where one of = !="),
        ("image_rate ** 2 > 3", "has '**' where one of = !="),
        ("dataset in room", "where '(' belongs"),
        ("dataset in [room", "where ']' belongs"),
        ("and > 5", "has 'and' where"),
        ("image_rate > 5 ms", "'5 ms' has a unit (at character 14)"),
        (
            "image_rate between 3 and 1",
            "nothing lies between 3 and 1 (at character 1); write image_rate",
        ),
        ("a in (" + "1, " * 600 + "1)", "a list has more than 500 values"),
        ("not " * 60 + "a > 1", "nested deeper"),
        ("(" * 60 + "a > 1" + ")" * 60, "nested deeper"),
        ("a > 1 or " * 400 + "a > 1", "characters, at most"),
    ],
)
def test_what_is_not_understood_is_named(text, message):
    with pytest.raises(InvalidInput) as caught:
        parse_condition(text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_text_is_not_larger_than_a_number():
    with pytest.raises(InvalidInput, match="compares text with a number"):
        decide("dataset > 5")


def test_a_matrix_is_not_larger_than_a_number():
    with pytest.raises(InvalidInput, match="compares a matrix"):
        parse_condition("T > 5").decide({"T": (1.0, 2.0)}, frozenset({"T"}))


def test_names_on_the_left_are_told():
    assert compared_names(parse_condition("a > b and not (c == 1 or d.e in [f])")) == {"a", "c", "d.e"}
