"""What verdicts look at: coverage by the estimate's own spacing, and the error beside what was travelled."""

import numpy as np
import pytest

from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.evaluation.evaluators.builtin import EVALUATORS
from slamhive.evaluation.evaluators.completeness import TrackingCoverage
from slamhive.evaluation.evaluators.evo_errors import RelativeSize
from slamhive.trajectory.completeness import measure_own_coverage
from slamhive.trajectory.model import Trajectory
from tests.evaluation.evaluators.curves import loop, moved, noisy, paired, road

SPAN_S = 100.0
UNALIGNED = Protocol(Alignment.NONE)


def straight(stamps_s, positions_m=None):
    """At 1 m/s, unless it is told where it was."""
    stamps_s = np.asarray(stamps_s, dtype=float)
    along_m = stamps_s if positions_m is None else np.asarray(positions_m, dtype=float)
    positions = np.column_stack([along_m, np.zeros((len(along_m), 2))])
    return Trajectory(stamps_s, positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(stamps_s), 1)))


TRUTH = straight(np.linspace(0, SPAN_S, 2001))


@pytest.mark.parametrize(
    ("stamps_s", "share", "gap_s"),
    [
        (np.linspace(0, 100, 2001), 1.0, 1.0),
        (np.linspace(0, 100, 51), 1.0, 10.0),
        (np.linspace(0, 100, 6), 0.0, 10.0),
        (np.linspace(0, 60, 31), 0.6, 10.0),
        (np.concatenate([np.linspace(0, 25, 26), np.linspace(75, 100, 26)]), 0.5, 10.0),
        (np.concatenate([np.linspace(0, 25, 501), np.linspace(75, 100, 501)]), 0.5, 1.0),
        (np.linspace(200, 300, 11), 0.0, 10.0),
        (np.array([50.0]), 0.0, 1.0),
    ],
)
def test_gaps_are_judged_by_the_spacing_of_the_estimate(stamps_s, share, gap_s):
    found = measure_own_coverage(stamps_s, TRUTH, 1.0)
    assert found.gap_s == pytest.approx(gap_s)
    assert [found.path_share, found.time_share] == pytest.approx([share, share])


def test_standing_still_covers_no_path():
    """A drone that waits for 40 s before it takes off: a system that begins when it moves has missed nothing."""
    stamps_s = np.linspace(0, SPAN_S, 2001)
    truth = straight(stamps_s, np.maximum(0.0, stamps_s - 40))
    found = measure_own_coverage(np.linspace(40, 100, 1201), truth, 1.0)
    assert [found.path_share, found.time_share] == pytest.approx([1.0, 0.6])


def test_where_nothing_moves_time_counts():
    truth = straight(np.linspace(0, SPAN_S, 2001), np.zeros(2001))
    assert measure_own_coverage(np.linspace(0, 60, 1201), truth, 1.0).path_share == pytest.approx(0.6)


def test_what_was_travelled_in_a_gap_of_the_ground_truth_is_taken_from_its_mean_speed():
    """Ground truth at both ends only, as in TUM VI: an estimate that lost the middle has not covered everything."""
    ends_s = np.concatenate([np.linspace(0, 10, 201), np.linspace(90, 100, 201)])
    along_m = np.concatenate([np.linspace(0, 10, 201), np.linspace(10, 20, 201)])
    lost = np.concatenate([np.linspace(0, 10, 201), np.linspace(90, 100, 201)])
    found = measure_own_coverage(lost, straight(ends_s, along_m), 1.0)
    assert found.path_share == pytest.approx(0.2)


@pytest.mark.parametrize("make", [TrackingCoverage, RelativeSize])
def test_every_key_is_in_the_catalogue_and_accounted_for(make):
    evaluator = make()
    figures = evaluator.evaluate(paired(loop(), noisy(loop())))
    assert set(evaluator.keys) <= set(CATALOGUE)
    assert sorted([*figures.values, *figures.missing]) == sorted(evaluator.keys)
    assert any(registered.keys == evaluator.keys for _, registered in EVALUATORS)


def test_an_estimate_without_error_has_none_beside_what_was_travelled():
    figures = RelativeSize().evaluate(paired(road(), moved(road())))
    assert figures.values == pytest.approx({"ate.per_path": 0, "ate.per_extent": 0}, abs=1e-6)


def test_an_estimate_that_hardly_moves_has_the_error_of_standing_still():
    truth = road()
    shrunk = Trajectory(truth.stamps_s, 1e-6 * truth.positions_m, truth.quats_xyzw)
    found = RelativeSize().evaluate(paired(truth, shrunk)).values
    extent_m = np.sqrt(np.mean(np.sum((truth.positions_m - truth.positions_m.mean(axis=0)) ** 2, axis=1)))
    assert found["ate.per_extent"] == pytest.approx(100.0, rel=1e-3)
    assert found["ate.per_path"] == pytest.approx(100 * extent_m / truth.path_length_m, rel=1e-3)


def test_without_any_motion_there_is_nothing_to_compare_with():
    still = straight(np.linspace(0, 10, 101), np.zeros(101))
    figures = RelativeSize().evaluate(paired(still, straight(np.linspace(0, 10, 101)), UNALIGNED))
    assert figures.missing == dict.fromkeys(RelativeSize.keys, "the ground truth does not move")
