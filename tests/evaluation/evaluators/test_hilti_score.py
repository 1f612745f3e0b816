"""The score of the Hilti challenge of 2026, against its published steps done one by one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.evaluation.evaluators.completeness import HILTI, HiltiScore
from slamhive.evaluation.pairing import pair
from slamhive.evaluation.references import TruthReference
from slamhive.trajectory.model import Trajectory

RATE_HZ = 10.0


def path(count: int = 400) -> np.ndarray:
    t = np.arange(count) / RATE_HZ
    return np.stack([5 * np.sin(t / 3), 4 * np.cos(t / 5), 0.3 * np.sin(t)], axis=1)


def trajectory(stamps_s, positions_m) -> Trajectory:
    quats = np.tile([0.0, 0.0, 0.0, 1.0], (len(stamps_s), 1))
    return Trajectory(np.asarray(stamps_s, dtype=float), np.asarray(positions_m, dtype=float), quats)


def score(truth: Trajectory, estimate: Trajectory, protocol: Protocol = HILTI):
    return HiltiScore().evaluate(pair(TruthReference(truth), estimate, protocol)).values


def by_hand(truth: Trajectory, estimate: Trajectory) -> float:
    """Each step by itself: skip, nearest pose, coverage, rotation by SVD, mean of exponentials."""
    pairs = []
    later = [i for i, stamp in enumerate(truth.stamps_s) if stamp >= truth.stamps_s[0] + 5.0]
    for i in later:
        gaps = [abs(stamp - truth.stamps_s[i]) for stamp in estimate.stamps_s]
        j = gaps.index(min(gaps))
        if gaps[j] <= 0.05:
            pairs.append((i, j))
    if 100.0 * len(pairs) / len(later) < 99.0:
        return 0.0
    q = np.array([truth.positions_m[i] for i, _ in pairs])
    p = np.array([estimate.positions_m[j] for _, j in pairs])
    u, _, vt = np.linalg.svd((p - p.mean(0)).T @ (q - q.mean(0)))
    rotation = vt.T @ np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    moved = (p - p.mean(0)) @ rotation.T + q.mean(0)
    return sum(
        100 * math.exp(-0.46051701859880917 * float(np.linalg.norm(a - b))) for a, b in zip(moved, q, strict=True)
    ) / len(q)


@pytest.mark.parametrize(("sigma_m", "shift_s"), [(0.01, 0.0), (0.5, 0.02), (3.0, 0.04)])
def test_it_is_what_the_steps_give(sigma_m: float, shift_s: float):
    stamps_s, random = 1000 + np.arange(400) / RATE_HZ, np.random.default_rng(3)
    truth = trajectory(stamps_s, path())
    turned = path() @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) + 7.0
    estimate = trajectory(stamps_s + shift_s, turned + random.normal(0, sigma_m, (400, 3)))
    found = score(truth, estimate)["hilti.score"]
    assert found == pytest.approx(by_hand(truth, estimate), rel=1e-9)
    assert 0 < found < 100


def test_a_perfect_estimate_has_100_and_the_first_seconds_do_not_count():
    stamps_s = np.arange(400) / RATE_HZ
    wrong = path()
    wrong[:50] += 30.0
    assert score(trajectory(stamps_s, path()), trajectory(stamps_s, wrong))["hilti.score"] == pytest.approx(100.0)


def test_ten_metres_are_one_point():
    assert 100 * math.exp(-0.46051701859880917 * 10) == pytest.approx(1.0)


@pytest.mark.parametrize(("missing", "counts"), [(3, True), (4, False)])
def test_below_99_percent_coverage_it_is_zero(missing: int, counts: bool):
    stamps_s = np.arange(400) / RATE_HZ
    kept = np.delete(np.arange(400), 100 + 2 * np.arange(missing))  # 3 of 350 are 0.86 %, 4 are 1.14 %
    truth, estimate = trajectory(stamps_s, path()), trajectory(stamps_s[kept], path()[kept])
    found = score(truth, estimate)["hilti.score"]
    assert found == pytest.approx(by_hand(truth, estimate))
    assert (found > 0) is counts


def test_it_belongs_to_its_protocol_alone():
    stamps_s = np.arange(400) / RATE_HZ
    both = trajectory(stamps_s, path())
    assert score(both, both, Protocol(Alignment.SE3)) == {}
    short = trajectory(stamps_s[:40], path()[:40])
    with pytest.raises(InvalidInput, match="ends within its first 5 s"):
        score(short, short)
