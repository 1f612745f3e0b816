from __future__ import annotations

import pytest

from slamhive.domain.algorithm import Bound
from slamhive.domain.configuration import Playback
from slamhive.domain.protocol import Alignment

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


WITHOUT_TRUTH = Bound("aces", 7374, None, Alignment.SE3, Playback(), {}, relations_m=0.25, relations_deg=1.2)


@pytest.mark.parametrize(
    ("metrics", "problem"),
    [
        ({"relations.translation.mean": 0.25, "relations.rotation.mean": 1.2}, None),
        (
            {"relations.translation.mean": 0.26, "relations.rotation.mean": 1.0},
            "mean translation error of the relations 0.26 m, at most 0.25 m is allowed",
        ),
        (
            {"relations.translation.mean": 0.1, "relations.rotation.mean": 2.3},
            "mean rotation error of the relations 2.3 deg, at most 1.2 deg is allowed",
        ),
        ({"relations.translation.mean": 0.1}, "the trajectory could not be evaluated"),
        ({"ate.rmse": 0.01}, "the trajectory could not be evaluated"),
    ],
)
def test_without_ground_truth_relations_are_bounded(metrics, problem):
    assert WITHOUT_TRUTH.broken_by(7374, metrics) == problem
    assert WITHOUT_TRUTH.words == "≥ 7374 poses, relations ≤ 0.25 m, ≤ 1.2 deg"


def test_a_bound_in_words_names_its_alignment():
    assert BOUND.words == "≥ 149 poses, ATE ≤ 0.03 m (SE(3))"
