"""The synthetic checks that every implementation has to pass, and the figures of trajectories that are known."""

import math
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import CATALOGUE, Direction
from slamhive.domain.protocol import Alignment, Association, Protocol, RpePairs
from slamhive.evaluation.evaluators.base import ROTATIONS_UNKNOWN
from slamhive.evaluation.evaluators.completeness import (
    Robustness,
    ScaleErrors,
    StartEndDrift,
    count_losses,
    score_seconds,
)
from slamhive.evaluation.evaluators.evo_errors import RotationError
from slamhive.evaluation.evaluators.relative import DistanceErrors, RelativeErrors, all_pairs, consecutive_pairs
from slamhive.evaluation.evaluators.segments import KittiProtocol, SegmentDistances, SegmentErrors, kitti_segments
from slamhive.trajectory.model import Trajectory
from tests.evaluation.evaluators.curves import SE3, kept, loop, moved, noisy, paired, road, rotation_z, scaled

OF_A_GIVEN_LENGTH = re.compile(r"segment\.(\w+)\.\d+c?m(\.\w+)?")
"""MetricValues of segments that only a protocol which gives lengths has."""
ALL = (
    RotationError,
    RelativeErrors,
    DistanceErrors,
    KittiProtocol,
    SegmentErrors,
    SegmentDistances,
    ScaleErrors,
    StartEndDrift,
    Robustness,
)


@pytest.mark.parametrize("make", ALL)
def test_every_key_is_in_the_catalogue_and_accounted_for(make):
    evaluator = make()
    figures = evaluator.evaluate(paired(road(), noisy(road())))
    assert set(evaluator.keys) <= set(CATALOGUE)
    asked = [key for key in evaluator.keys if not OF_A_GIVEN_LENGTH.fullmatch(key)]
    assert sorted([*figures.values, *figures.missing]) == sorted(asked)
    assert all(math.isfinite(value) for value in figures.values.values())
    assert all(reason and "\n" not in reason for reason in figures.missing.values())


@pytest.mark.parametrize("make", [m for m in ALL if m not in (StartEndDrift, Robustness)])
@pytest.mark.parametrize("pairs", list(RpePairs))
def test_a_rigid_move_gives_zero_everywhere(make, pairs):
    figures = make().evaluate(paired(road(), moved(road()), Protocol(Alignment.SE3, rpe_pairs=pairs)))
    errors = {key: value for key, value in figures.values.items() if CATALOGUE[key].direction is Direction.LOWER}
    assert errors
    for key, value in errors.items():
        # An arc cosine in single precision, as the devkit's, is no better than 3e-4 rad near zero: over 100 m.
        assert value == pytest.approx(0, abs=3e-4 if key.startswith("kitti.rotation") else 1e-6), key


DEVKIT = Protocol(Alignment.NONE, association=Association.INDEX)


@pytest.fixture
def published(tmp_path):
    """A winding road and an estimate as KITTI files of few digits: their matrices are not quite orthonormal."""
    files = {}
    for name, trajectory, digits in (("kitti_reference", road(), 9), ("kitti_estimate", scaled(road(), 1.01), 3)):
        T = as_matrices(trajectory)[:, :3]
        T[:, :, :3] = T[:, :, :3].round(digits)
        files[name] = tmp_path / f"{name}.txt"
        np.savetxt(files[name], T.reshape(-1, 12), fmt="%.9f")
    return files


def test_the_devkit_takes_the_matrices_of_kitti_files_as_they_are(published):
    pair = paired(road(), scaled(road(), 1.01), DEVKIT, files=published)
    whole = KittiProtocol().evaluate(pair).values
    T = [np.pad(np.loadtxt(path).reshape(-1, 3, 4), ((0, 0), (0, 1), (0, 0))) for path in published.values()]
    for matrices in T:
        matrices[:, 3, 3] = 1
    expected = kitti_segments(*T)
    assert whole["kitti.rotation"] == pytest.approx(np.rad2deg(expected.rotations_radpm.mean()), rel=1e-5)
    assert whole["kitti.translation"] == pytest.approx(100 * expected.translations.mean(), rel=1e-5)
    without = KittiProtocol().evaluate(paired(road(), scaled(road(), 1.01), DEVKIT)).values
    assert without["kitti.rotation"] < 0.5 * whole["kitti.rotation"]


@pytest.mark.parametrize(
    "protocol",
    [
        replace(DEVKIT, alignment=Alignment.SE3),
        Protocol(Alignment.NONE),
        replace(DEVKIT, reference="a.txt"),
    ],
)
def test_what_was_moved_or_matched_otherwise_is_no_longer_what_the_file_has(published, protocol):
    with_files = KittiProtocol().evaluate(paired(road(), road(), protocol, files=published)).values
    assert with_files == KittiProtocol().evaluate(paired(road(), road(), protocol)).values


def test_a_kitti_file_of_other_poses_is_refused(published):
    with pytest.raises(InvalidInput, match=r"kitti_estimate\.txt does not hold the poses of the trajectory"):
        KittiProtocol().evaluate(paired(road(), road(), DEVKIT, files=published))


def test_a_scale_of_two_percent():
    pair = paired(road(), scaled(road(), 1.02))
    assert KittiProtocol().evaluate(pair).values["kitti.translation"] == pytest.approx(2.0, abs=0.05)
    assert SegmentErrors().evaluate(pair).values["segment.translation"] == pytest.approx(2.0, abs=0.05)
    assert SegmentDistances().evaluate(pair).values["segment_point.error"] == pytest.approx(2.0, abs=0.1)
    scales = ScaleErrors().evaluate(pair).values
    assert scales["scale.error"] == pytest.approx(2.0)
    assert scales["scale.drift"] == pytest.approx(0.0, abs=1e-9)
    by_sim3 = paired(road(), scaled(road(), 1.02), Protocol(Alignment.SIM3))
    assert KittiProtocol().evaluate(by_sim3).values["kitti.translation"] == pytest.approx(0.0, abs=1e-3)
    assert ScaleErrors().evaluate(by_sim3).values["scale.error"] == pytest.approx(2.0)


def test_a_scale_that_grows_is_scale_drift():
    truth = road()
    steps = np.diff(truth.positions_m, axis=0) * np.linspace(0.9, 1.1, len(truth) - 1)[:, None]
    positions_m = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    values = ScaleErrors().evaluate(paired(truth, Trajectory(truth.stamps_s, positions_m, truth.quats_xyzw))).values
    assert values["scale.drift"] == pytest.approx(5.0, abs=0.1)  # mean of |s - 1| for s even from 0.9 to 1.1


def test_the_missing_middle_shows_in_the_score_and_not_in_the_error():
    truth = loop()
    middle = (truth.stamps_s >= 110) & (truth.stamps_s < 130)
    whole, half = paired(truth, moved(truth)), paired(truth, kept(moved(truth), ~middle))
    errors_m = np.linalg.norm(half.aligned.positions_m - half.matched_reference.positions_m, axis=1)
    assert errors_m.max() == pytest.approx(0, abs=1e-9)
    assert Robustness().evaluate(whole).values["completeness.score"] == pytest.approx(1.0)
    values = Robustness().evaluate(half).values
    assert values["completeness.score"] == pytest.approx(0.5, abs=0.01)
    assert values["tracking.losses"] == 1
    assert values["time_to_first_pose"] == 0


def test_pauses_of_the_ground_truth_are_no_part_of_the_score():
    """Ground truth at both ends only, as of TUM VI: a perfect estimate of the whole has the score 1."""
    ends = kept(loop(), (np.arange(400) < 60) | (np.arange(400) >= 340))
    assert Robustness().evaluate(paired(ends, loop())).values["completeness.score"] == pytest.approx(1.0)
    half = kept(loop(), np.arange(400) < 60)
    score = Robustness().evaluate(paired(ends, half)).values["completeness.score"]
    assert score == pytest.approx(0.5, abs=0.01)
    rare = kept(loop(), np.arange(400) % 30 == 0)
    figures = Robustness().evaluate(paired(rare, loop()))
    assert figures.missing == {
        "completeness.score": "the poses of the ground truth are more than 1 s apart, the gap threshold"
    }


def test_a_pose_that_is_held_is_no_pose_for_the_score():
    lost = kept(loop(), np.arange(400) < 200)
    scores = [
        Robustness().evaluate(paired(loop(), lost, Protocol(Alignment.NONE, association=association))).values
        for association in (Association.HOLD, Association.NEAREST)
    ]
    assert scores[0]["completeness.score"] == pytest.approx(scores[1]["completeness.score"], abs=0.005)


def test_the_score_integrates_errors_that_cross_the_limit():
    """Errors between poses are straight lines; what is beyond the limit is cut off exactly, not pose by pose."""
    random = np.random.default_rng(3)
    stamps_s = np.cumsum(random.uniform(0.05, 1.2, 60))
    errors_m = random.exponential(1.0, 60)
    errors_m[10], errors_m[20:23] = np.inf, 3.0
    gap_s, limit_m = 1.0, 1.0
    area_s = 0.0
    for (begin_s, end_s), (first_m, last_m) in zip(pairwise(stamps_s), pairwise(errors_m), strict=True):
        if end_s - begin_s <= gap_s and np.isfinite(first_m + last_m):
            share = (np.arange(200_000) + 0.5) / 200_000
            goodness = np.maximum(0.0, 1.0 - (first_m + share * (last_m - first_m)) / limit_m)
            area_s += (end_s - begin_s) * goodness.mean()
    assert score_seconds(stamps_s, errors_m, gap_s, limit_m) == pytest.approx(area_s, rel=1e-9)
    crossing = score_seconds(np.array([0.0, 1.0]), np.array([0.0, 2.0]), gap_s, limit_m)
    assert crossing == pytest.approx(0.25), "good for half of the second, at half on average"


def test_the_score_is_the_area_under_the_share_within():
    truth = loop()
    shift_m = np.zeros((len(truth), 3))
    shift_m[:, 2] = 0.25
    shift_m[len(truth) // 2 :, 2] = 7.0
    off = Trajectory(truth.stamps_s, truth.positions_m + shift_m, truth.quats_xyzw)
    score = Robustness().evaluate(paired(truth, off, Protocol(Alignment.NONE))).values["completeness.score"]
    assert score == pytest.approx(0.5 * 0.75, abs=0.003)


@pytest.mark.parametrize(
    ("stamps_s", "losses"),
    [
        ([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10], 0),
        ([4, 5, 6, 7, 8, 9, 10], 0),
        ([0, 1, 2, 5, 6, 9, 10], 2),
        ([0, 1, 2], 1),
        ([-5, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 90], 0),
        ([3], 1),
    ],
)
def test_losses_are_pauses_after_the_first_pose(stamps_s, losses):
    assert count_losses(np.array(stamps_s, dtype=float), 0.0, 10.0, 1.5) == losses


def test_the_first_pose_may_be_late():
    truth = loop()
    late = paired(truth, kept(truth, truth.stamps_s >= 107.5))
    assert Robustness().evaluate(late).values["time_to_first_pose"] == pytest.approx(7.5, abs=0.1)


def test_a_turned_estimate_has_that_rotation_error():
    truth = loop()
    turned = Trajectory(truth.stamps_s, truth.positions_m, rotation_z(np.linspace(0, 2 * np.pi, 400) + np.pi / 2 + 0.1))
    values = RotationError().evaluate(paired(truth, turned)).values
    assert values["ate_rot.rmse"] == pytest.approx(np.rad2deg(0.1))
    assert values["ate_rot.max"] == pytest.approx(np.rad2deg(0.1))


def test_a_constant_drift_has_the_same_relative_error_by_any_delta():
    truth = road()
    drifting = Trajectory(
        truth.stamps_s, truth.positions_m + 0.01 * np.arange(2000)[:, None] * [0, 0, 1], truth.quats_xyzw
    )
    protocol = Protocol(Alignment.NONE, rpe_delta_frames=20, rpe_delta_s=2.0)
    values = RelativeErrors().evaluate(paired(truth, drifting, protocol)).values
    for unit in ("frames", "seconds"):
        for name in ("rmse", "median", "max"):
            # By time, the last pair may be a tenth shorter.
            assert values[f"rpe.{unit}.{name}"] == pytest.approx(0.2, abs=1e-5)


def test_a_delta_that_no_pair_has_leaves_its_figures_out():
    protocol = Protocol(Alignment.SE3, rpe_delta_s=100.0, rpe_delta_m=1000.0, rpe_delta_frames=400, rpe_delta_deg=1.0)
    figures = RelativeErrors().evaluate(paired(loop(), noisy(loop()), protocol))
    assert figures.missing["rpe.seconds.rmse"] == "no pair of poses is 100 s apart"
    assert figures.missing["rpe_rot.max"] == "no pair of poses is 1000 m of path apart"
    assert figures.missing["rpe.frames.max"] == "no pair of poses is 400 frames apart"
    assert "rpe.degrees.rmse" in figures.values


@pytest.mark.parametrize("make", [RotationError, RelativeErrors, KittiProtocol, SegmentErrors])
def test_positions_alone_have_no_errors_that_need_orientations(make):
    figures = make().evaluate(paired(road(), road(), rotations_known=False))
    assert figures.values == {}
    assert set(figures.missing.values()) == {ROTATIONS_UNKNOWN}


@pytest.mark.parametrize(
    ("protocol", "how"), [(SE3, "by time"), (Protocol(Alignment.SE3, association=Association.ONE_TO_ONE), "by time")]
)
def test_one_missing_pose_rejects_the_run_for_kitti(protocol, how):
    truth = road()
    with pytest.raises(InvalidInput, match=f"1999 of 2000 are matched {how}"):
        KittiProtocol().evaluate(paired(truth, kept(truth, np.arange(2000) != 77), protocol))


def test_a_short_path_has_no_kitti_segment():
    figures = KittiProtocol().evaluate(paired(loop(), loop()))
    assert figures.values == {}
    assert "the shortest segment 100 m" in figures.missing["kitti.translation"]


def test_a_path_of_700_m_has_no_segment_of_800_m():
    truth = kept(road(), np.arange(1250))
    figures = KittiProtocol().evaluate(paired(truth, noisy(truth)))
    assert figures.missing == dict.fromkeys(
        ["kitti.translation.800m", "kitti.rotation.800m", "kitti.segments.800m"], "no segment is 800 m long"
    )


def test_segments_of_given_lengths():
    pair = paired(
        road(), scaled(road(), 1.01), Protocol(Alignment.SE3, segment_lengths_m=(8.0, 16.0), segment_tolerance_m=0.5)
    )
    figures = SegmentErrors().evaluate(pair)
    assert figures.values["segment.translation"] == pytest.approx(1.0, abs=0.1)
    assert not figures.missing
    assert not [key for key in figures.values if key.endswith("pct")], "shares of the path are not asked for"
    one = figures.values
    assert one["segment.metres.8m.mean"] == pytest.approx(0.08, abs=0.01)
    assert one["segment.count"] == one["segment.count.8m"] + one["segment.count.16m"]
    far = Protocol(Alignment.SE3, segment_lengths_m=(1e6,))
    assert (
        "has no segment of 1e+06 m" in SegmentErrors().evaluate(paired(road(), road(), far)).missing["segment.rotation"]
    )


def test_an_estimate_on_a_line_names_the_rank_and_keeps_the_local_scale():
    count = 200
    line = np.column_stack([np.arange(count) * 0.1, np.zeros(count), np.zeros(count)])
    truth = Trajectory(np.arange(count) / 10, line, rotation_z(np.zeros(count)))
    figures = ScaleErrors().evaluate(paired(truth, truth, Protocol(Alignment.NONE)))
    assert "straight line" in figures.missing["scale.error"]
    assert figures.values["scale.drift"] == pytest.approx(0, abs=1e-9)


class TestStartEndDrift:
    @staticmethod
    def ends_only(trajectory: Trajectory) -> Trajectory:
        share = np.arange(len(trajectory)) / len(trajectory)
        return kept(trajectory, (share < 0.2) | (share > 0.8))

    def test_without_drift_there_is_none(self):
        values = StartEndDrift().evaluate(paired(self.ends_only(loop()), moved(loop()))).values
        assert all(value == pytest.approx(0, abs=1e-6) for value in values.values())
        assert len(values) == 4

    def test_a_jump_in_the_middle_is_found(self):
        truth = loop()
        jump_m = np.where(np.arange(len(truth))[:, None] < 200, 0.0, [0.3, 0.4, 0.0])
        jumped = Trajectory(truth.stamps_s, truth.positions_m + jump_m, truth.quats_xyzw)
        values = StartEndDrift().evaluate(paired(self.ends_only(truth), jumped)).values
        assert values["drift.alignment"] == pytest.approx(0.5, abs=1e-6)
        assert values["drift.end"] == pytest.approx(100 * 0.5 / jumped.path_length_m, abs=1e-6)
        assert values["drift.rotation"] == pytest.approx(0, abs=1e-6)
        assert values["drift.scale"] == 0

    def test_a_change_of_scale_shows_where_the_alignment_has_one(self):
        truth = loop()
        factor = np.where(np.arange(len(truth))[:, None] < 200, 1.0, 1.1)
        grown = Trajectory(truth.stamps_s, truth.positions_m * factor, truth.quats_xyzw)
        values = StartEndDrift().evaluate(paired(self.ends_only(truth), grown, Protocol(Alignment.SIM3))).values
        assert values["drift.scale"] == pytest.approx(100 * (1 - 1 / 1.1))

    def test_ground_truth_that_covers_all_has_no_drift_figures(self):
        assert "covers the whole run" in StartEndDrift().evaluate(paired(loop(), loop())).missing["drift.end"]

    def test_an_end_that_was_not_tracked_is_named(self):
        truth = self.ends_only(loop())
        lost = kept(loop(), np.arange(400) < 300)
        with pytest.raises(InvalidInput, match="drift needs an alignment at the end of the ground truth"):
            StartEndDrift().evaluate(paired(truth, lost))


@pytest.mark.integration
@pytest.mark.parametrize(("unit", "delta"), [("seconds", 1.0), ("degrees", 10.0)])
def test_all_pairs_by_seconds_and_degrees_equal_a_search_by_hand(unit, delta):
    """Every later pose is tried, with matrices and another library's angles; the nearest within a tenth counts."""
    pair = paired(loop(), noisy(loop()))
    true, estimated = (as_matrices(poses) for poses in (pair.matched_reference, pair.aligned))
    turns = np.degrees([angle_rad(np.linalg.inv(a) @ b) for a, b in pairwise(estimated)])
    along = pair.aligned.stamps_s if unit == "seconds" else np.concatenate(([0.0], np.cumsum(turns)))
    errors = []
    for i in range(len(along) - 1):
        off = [abs(along[j] - along[i] - delta) for j in range(i + 1, len(along))]
        j = i + 1 + off.index(min(off))
        if min(off) <= delta / 10:
            moves = [np.linalg.inv(poses[i]) @ poses[j] for poses in (true, estimated)]
            errors.append(np.linalg.inv(moves[0]) @ moves[1])
    assert len(errors) > 200
    figures = RelativeErrors().evaluate(pair).values
    for part, found in (
        ("rpe", np.array([np.linalg.norm(E[:3, 3]) for E in errors])),
        ("rpe_rot", np.degrees([angle_rad(E) for E in errors])),
    ):
        assert figures[f"{part}.{unit}.rmse"] == pytest.approx(np.sqrt(np.mean(found**2)), rel=1e-9)
        assert figures[f"{part}.{unit}.median"] == pytest.approx(np.median(found), rel=1e-9)
        assert figures[f"{part}.{unit}.max"] == pytest.approx(np.max(found), rel=1e-9)


def as_matrices(poses):
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = Rotation.from_quat(poses.quats_xyzw).as_matrix(), poses.positions_m
    return matrices


def angle_rad(T):
    return Rotation.from_matrix(T[:3, :3]).magnitude()


def test_pairs_take_the_nearest_and_the_first_of_equals():
    values = np.array([0.0, 0.4, 1.0, 1.0, 1.0, 1.3, 2.0])
    i, j = all_pairs(values, 1.0, 0.1)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == [(0, 2), (1, 5), (2, 6), (3, 6), (4, 6)]
    i, j = consecutive_pairs(values, 0.9)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == [(0, 2), (2, 6)]
    assert len(all_pairs(np.zeros(5), 1.0, 0.1)[0]) == len(consecutive_pairs(np.zeros(5), 1.0)[0]) == 0
