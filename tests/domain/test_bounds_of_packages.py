from __future__ import annotations

import pytest

from slamhive.domain.bounds import Bound
from slamhive.domain.configuration import Playback
from slamhive.domain.protocol_choices import Alignment

BOUND = Bound("room", 149, 0.03, Alignment.SE3, Playback(), {})


@pytest.mark.parametrize(
    ("poses", "metrics", "problem"),
    [
        (149, {"ate.rmse": 0.03}, None),
        (148, {"ate.rmse": 0.01}, "148 poses, at least 149 are needed"),
        (None, {}, "0 poses, at least 149 are needed"),
        (150, {"ate.rmse": 0.0301}, "ATE RMSE 0.0301 m, at most 0.03 m is allowed"),
        (150, {}, "the trajectory could not be evaluated"),
    ],
)
def test_a_run_keeps_its_bound_or_says_why_not(poses, metrics, problem):
    assert BOUND.broken_by(poses, metrics) == problem


def test_a_bound_in_words_names_its_alignment():
    assert BOUND.words == "≥ 149 poses, ATE ≤ 0.03 m (SE(3))"
