"""What a submission may say, and how it is parsed from JSON."""

from __future__ import annotations

from typing import Any

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.documents.limits import Option, StopWhen
from slamhive.documents.model import parse
from slamhive.documents.submission import OPTIONS, Submission


@pytest.mark.parametrize("option", OPTIONS.values(), ids=lambda option: option.name)
def test_every_option_says_what_it_is(option: Option):
    assert option.help.endswith(".")
    assert option.title


def test_a_submission_is_parsed_strictly_from_json():
    content = {
        "algorithm": "a",
        "dataset": "d",
        "parameters": {"n": 3, "x": 1.0, "K": [1, 2], "on": True, "s": "text"},
        "variant": [{"kind": "rate", "sensors": ["cam1", "cam0"], "options": {"hz": 5}}],
        "stop_when": {"time_s": 60},
        "alignment": "se3",
        "repeat_disturbed": 2,
    }
    found = parse(Submission, content)
    assert found.parameters == {"n": 3, "x": 1.0, "K": (1.0, 2.0), "on": True, "s": "text"}
    assert found.variant[0].sensors == ("cam0", "cam1")
    assert found.stop_when == StopWhen(time_s=60.0)
    found.check()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"repeat": "2"}, "repeat: must be a whole number"),
        ({"stop_when": {"time": 3}}, "unknown key 'stop_when.time'; did you mean 'time_s'?"),
        ({"stop_when": {"time_s": 0}}, "stop_when.time_s: must be greater than 0"),
        ({"variant": [{"kind": "rate", "sensor": "cam0"}]}, "did you mean 'sensors'?"),
        ({"parameters": {"n": {"a": 1}}}, "parameters.n: has a type that is not allowed here"),
        ({"alignment": "magic"}, "alignment"),
        ({"prioriti": 3}, "unknown key 'prioriti'; did you mean 'priority'?"),
        ({"dataset": None}, "dataset: must be text"),
    ],
)
def test_what_is_no_submission_is_refused(change: dict[str, Any], message: str):
    with pytest.raises(InvalidInput) as refused:
        parse(Submission, {"algorithm": "a", "dataset": "d", **change})
    assert message in str(refused.value)
