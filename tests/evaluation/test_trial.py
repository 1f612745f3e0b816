"""A ground truth before systems that agree: real runs, with faults made on purpose and errors that all share."""

import numpy as np
import pytest

from benchmarks import truth_trial as cases
from slamhive.domain.dataset import Blame
from slamhive.evaluation.trial import judge_truth
from slamhive.trajectory.model import Trajectory

pytestmark = [
    pytest.mark.shared_data,
    pytest.mark.integration,
    pytest.mark.skipif(not cases.RUNS.is_dir(), reason="the recorded runs are not in ../shared/data/euroc_vio_runs"),
]


def test_clean_sequences_raise_no_alarm() -> None:
    wrong, count = cases.alarms(1)
    assert count == 6
    assert wrong == 0


def test_a_real_ground_truth_has_steps_on_which_all_systems_agree() -> None:
    """MH_03, measured by a laser tracker: at 35 s its speed is 1.3 m/s, then 1.9 m/s for 0.1 s, then 1.4 m/s."""
    truth, systems = cases.case("MH_03", 0)
    found = cases.judged(truth, systems)
    at_35_s = [entry for entry in found.stretches if abs(entry.begin_s - truth.stamps_s[0] - 35.2) < 2]
    assert len(at_35_s) == 1
    assert at_35_s[0].blame is Blame.TRUTH
    assert 0.04 < at_35_s[0].max_m < 0.15
    assert {"vio_mono", "vio_stereo", "vislam_rp"} <= {*at_35_s[0].agreeing}


def test_faults_of_the_ground_truth_are_found() -> None:
    """Of 60 cases of each, benchmarks/truth_trial.py finds 90 % or more; a few of each are tried here."""
    found = [cases.recall(fault, 6, 5) for fault in cases.FAULTS.values()] + [cases.arm_recall(6, 5)]
    assert np.mean(found) >= 0.9


def test_a_small_jump_of_the_truth_does_not_explain_a_large_contradiction() -> None:
    """The ground truth of MH_05 has a jerk of 5 cm at 84 s, within an excursion of 37 cm that all systems share."""
    truth, systems = cases.case("MH_05", 1)
    shared = cases.shared_errors(float(truth.stamps_s[0]) + 85)["excursion of 0.37 m over 15 s"]
    found = cases.judged(truth, {name: shared(estimate) for name, estimate in systems.items()}, shared=True)
    assert [entry.blame for entry in found.stretches] == [Blame.UNDECIDED] * len(found.stretches)
    assert found.stretches


@pytest.mark.parametrize("error", list(cases.shared_errors(0.0)))
def test_an_error_that_all_systems_share_does_not_outvote_the_truth(error: str) -> None:
    wrong, _, _ = cases.outvoted(error, 1, cases.SEQUENCES[3:5])
    assert wrong == 0


def test_a_jump_is_told_with_its_time_its_size_and_who_agrees() -> None:
    truth, systems = cases.case("V2_02", 0)
    start_s = float(truth.stamps_s[0])
    moved = truth.positions_m.copy()
    moved[(truth.stamps_s > start_s + 40) & (truth.stamps_s < start_s + 46)] += [0.0, 0.1, 0.0]
    wrong = Trajectory(truth.stamps_s, moved, truth.quats_xyzw)
    sensors = {name: frozenset({"cam0", "imu0"}) for name in systems}
    found = judge_truth(wrong, systems, sensors)
    near = [entry for entry in found.stretches if entry.end_s > start_s + 39 and entry.begin_s < start_s + 47]
    assert near
    assert near[0].begin_s == pytest.approx(start_s + 40, abs=2)
    assert near[-1].end_s == pytest.approx(start_s + 46, abs=2)
    assert max(entry.max_m for entry in near) == pytest.approx(0.1, abs=0.04)
    # The systems share a camera and an IMU, but it is the ground truth that jumps.
    assert {entry.blame for entry in near} == {Blame.TRUTH}
    assert near[0].because == "it jumps where the systems move smoothly"
    during = (found.stamps_s > start_s + 39.5) & (found.stamps_s < start_s + 40.5)
    assert np.nanmax(found.common_m[during]) > 3 * np.nanmedian(found.common_m)


def test_two_systems_are_not_enough() -> None:
    truth, systems = cases.case("V2_02", 0)
    found = judge_truth(truth, dict(list(systems.items())[:2]))
    assert found.why_not == "3 systems are needed, 2 have poses that can be compared"
    rare = systems["vio_mono"].take(np.arange(0, len(systems["vio_mono"]), 50))
    keyframes = Trajectory(rare.stamps_s, rare.positions_m, rare.quats_xyzw)
    left = judge_truth(truth, {**systems, "vio_mono": keyframes}).left_out
    assert left["vio_mono"] == "it has poses at most 0.5 s apart in 0% of the time only"
