"""Offset, association and alignment on made-up trajectories: the synthetic checks, and what cannot be evaluated."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment, Association, FrameFit, Protocol
from slamhive.domain.sensors import IDENTITY4
from slamhive.evaluation.engine import all_metrics
from slamhive.evaluation.evaluators.base import Paired
from slamhive.evaluation.job import Artefacts, EvaluationResult, EvaluationTask
from slamhive.evaluation.pairing import pair
from slamhive.evaluation.references import References, TruthReference
from slamhive.evaluation.work import run_task
from slamhive.trajectory.layout import write_tum
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import move_sensor, multiply_quats, rotations_from_quats

pytestmark = pytest.mark.quick

TRUTH_S = np.arange(0.0, 40.0, 0.01)
ESTIMATE_S = np.arange(0.0, 40.0, 0.05)
SE3 = Protocol(Alignment.SE3)
LEVER_ARM = np.array([[0, 0, 1, 0.3], [-1, 0, 0, 0.1], [0, -1, 0, 0.2], [0, 0, 0, 1.0]])


def flight(stamps_s: np.ndarray) -> Trajectory:
    """A flight with turns about all axes, never twice alike."""
    t = stamps_s
    positions_m = np.column_stack([6 * np.sin(t / 4), 5 * np.sin(t / 3 + 1), np.sin(t / 2)])
    angles = (0.6 * np.sin(t / 2) + 0.1 * t, 0.3 * np.sin(t * 0.9), 0.2 * np.sin(t * 1.3))
    quats = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    for axis, angle in zip((2, 1, 0), angles, strict=True):
        turn = np.zeros((len(t), 4))
        turn[:, axis], turn[:, 3] = np.sin(angle / 2), np.cos(angle / 2)
        quats = multiply_quats(quats, turn)
    return Trajectory(t, positions_m, quats)


def elsewhere(trajectory: Trajectory, scale: float = 1.0) -> Trajectory:
    """The same motion in another world, of another scale."""
    turn = np.array([[0.1, 0.2, -0.3, np.sqrt(1 - 0.14)]])
    positions_m = scale * trajectory.positions_m @ rotations_from_quats(turn)[0].T + [5, -6, 7]
    return Trajectory(trajectory.stamps_s, positions_m, multiply_quats(turn, trajectory.quats_xyzw))


def later(trajectory: Trajectory, delay_s: float) -> Trajectory:
    return Trajectory(trajectory.stamps_s + delay_s, trajectory.positions_m, trajectory.quats_xyzw)


def figures(paired: Paired) -> dict[str, float]:
    return dict(all_metrics(paired).values)


TRUTH = TruthReference(flight(TRUTH_S))
ESTIMATE = flight(ESTIMATE_S)


def test_a_rigid_move_gives_zero_everywhere() -> None:
    found = figures(pair(TRUTH, elsewhere(ESTIMATE), SE3))
    kinds = {"ate", "ate_rot", "rpe", "rpe_rot"}
    errors = {key: value for key, value in found.items() if key.split(".")[0] in kinds and not key.endswith(".pairs")}
    assert len(errors) > 30
    assert max(errors.values()) < 1e-5
    assert found["segment.translation"] < 1e-5
    assert found["alignment.scale"] == 1
    assert found["tracked_fraction"] == pytest.approx(1, abs=2e-3)


def test_a_scale_is_zero_for_sim3_and_shows_as_scale_error() -> None:
    estimate = elsewhere(ESTIMATE, 1.02)
    sim3 = figures(pair(TRUTH, estimate, Protocol(Alignment.SIM3)))
    assert sim3["ate.rmse"] < 1e-9
    assert sim3["alignment.scale"] == pytest.approx(1 / 1.02)
    assert sim3["scale.error"] == pytest.approx(2.0)
    scaled = pair(TRUTH, Trajectory(ESTIMATE_S, ESTIMATE.positions_m * 1.02, ESTIMATE.quats_xyzw), SE3)
    only = pair(TRUTH, scaled.estimate, Protocol(Alignment.SCALE))
    assert only.transform.scale == pytest.approx(1 / 1.02)
    np.testing.assert_array_equal(only.transform.rotation, np.eye(3))


@pytest.mark.integration
@pytest.mark.parametrize("alignment", [Alignment.SE3, Alignment.SIM3, Alignment.NONE])
@pytest.mark.parametrize("delay_s", [0.05, -0.05, 0.73])
@pytest.mark.parametrize("rotations_known", [True, False])
def test_a_shift_of_the_stamps_is_found(alignment: Alignment, delay_s: float, rotations_known: bool) -> None:
    world = ESTIMATE if alignment is Alignment.NONE else elsewhere(ESTIMATE)
    shifted = later(world, delay_s)
    protocol = Protocol(alignment, offset_search_s=1.0)
    found = pair(TruthReference(TRUTH.trajectory, rotations_known), shifted, protocol)
    assert found.time_offset_s == pytest.approx(-delay_s, abs=2e-4)
    assert figures(found)["ate.rmse"] < 1e-3
    assert figures(found)["alignment.time_offset"] == found.time_offset_s
    assert figures(pair(TRUTH, shifted, Protocol(alignment)))["ate.rmse"] > 0.01


def test_a_given_offset_is_applied() -> None:
    shifted = later(ESTIMATE, 1000.0)
    found = pair(TRUTH, shifted, replace(SE3, time_offset_s=-1000.0))
    assert figures(found)["ate.rmse"] < 1e-9
    around = pair(TRUTH, later(shifted, 0.1), replace(SE3, time_offset_s=-1000.0, offset_search_s=0.5))
    assert around.time_offset_s == pytest.approx(-1000.1, abs=2e-4)


@pytest.mark.parametrize(
    ("estimate", "message"),
    [
        (later(ESTIMATE, 5.0), r"the time offset is not within 1 s of 0 s"),
        (later(ESTIMATE, 500.0), r"no time offset within 1 s of 0 s makes estimate and ground truth overlap"),
        (Trajectory(ESTIMATE_S, 0 * ESTIMATE.positions_m, ESTIMATE.quats_xyzw[[0] * len(ESTIMATE_S)]), None),
    ],
)
def test_an_offset_that_cannot_be_found_is_an_error(estimate: Trajectory, message: str | None) -> None:
    reference = TRUTH
    if message is None:
        still = np.tile(TRUTH.trajectory.quats_xyzw[0], (len(TRUTH_S), 1))
        reference, message = (
            TruthReference(Trajectory(TRUTH_S, 0 * TRUTH.trajectory.positions_m, still)),
            "they hardly move",
        )
    with pytest.raises(InvalidInput, match=message):
        pair(reference, estimate, Protocol(Alignment.NONE, offset_search_s=1.0))


@pytest.mark.integration
def test_the_missing_middle_half_shows_in_completeness_only() -> None:
    kept = (ESTIMATE_S < 10) | (ESTIMATE_S >= 30)
    estimate = Trajectory(ESTIMATE_S[kept], ESTIMATE.positions_m[kept], ESTIMATE.quats_xyzw[kept])
    found, whole = figures(pair(TRUTH, estimate, SE3)), figures(pair(TRUTH, ESTIMATE, SE3))
    assert found["ate.rmse"] < 1e-9
    assert found["tracked_fraction"] == pytest.approx(0.5, abs=0.01)
    assert found["completeness.score"] < 0.6 < whole["completeness.score"]
    held = figures(pair(TRUTH, estimate, Protocol(Alignment.SE3, association=Association.HOLD)))
    assert held["ate.rmse"] > 0.1, "an estimate that is held over the gap is wrong there"


def test_only_the_first_poses_are_aligned() -> None:
    bent = ESTIMATE.positions_m.copy()
    bent[200:] += [0, 0, 3]
    estimate = elsewhere(Trajectory(ESTIMATE_S, bent, ESTIMATE.quats_xyzw))
    errors_m = np.linalg.norm(
        (found := pair(TRUTH, estimate, Protocol(Alignment.SE3, align_poses=200))).aligned.positions_m
        - found.matched_reference.positions_m,
        axis=1,
    )
    assert errors_m[:200].max() < 1e-9
    assert errors_m[200:] == pytest.approx(3)


def test_the_first_pose_alone_leaves_the_drift_in() -> None:
    found = pair(TRUTH, elsewhere(ESTIMATE), Protocol(Alignment.FIRST_POSE))
    assert figures(found)["ate.rmse"] < 1e-9
    assert figures(found)["ate_rot.rmse"] < 1e-5


def test_one_pose_is_aligned_with_its_orientation() -> None:
    one, first = (
        pair(TRUTH, elsewhere(ESTIMATE), protocol).transform.matrix
        for protocol in (Protocol(Alignment.SE3, align_poses=1), Protocol(Alignment.FIRST_POSE))
    )
    assert one == pytest.approx(first)
    turned = turned_about_z(ESTIMATE, 2.2)
    found = pair(TRUTH, turned, Protocol(Alignment.YAW_POSITION, align_poses=1))
    assert figures(found)["ate.rmse"] < 1e-9
    assert figures(found)["ate_rot.rmse"] < 1e-5


def test_one_pose_that_is_upside_down_has_no_yaw() -> None:
    flip = np.array([[1.0, 0.0, 0.0, 0.0]])
    over = Trajectory(ESTIMATE_S, ESTIMATE.positions_m, multiply_quats(flip, ESTIMATE.quats_xyzw))
    with pytest.raises(InvalidInput, match="the first pose of the estimate is upside down"):
        pair(TRUTH, over, Protocol(Alignment.YAW_POSITION, align_poses=1))


def turned_about_z(trajectory: Trajectory, yaw_rad: float) -> Trajectory:
    """The same motion in a world that is turned about z and moved."""
    quat = np.array([[0.0, 0.0, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2)]])
    positions_m = trajectory.positions_m @ rotations_from_quats(quat)[0].T + [1.0, 2.0, 3.0]
    return Trajectory(trajectory.stamps_s, positions_m, multiply_quats(quat, trajectory.quats_xyzw))


def task(folder: Path, protocol: Protocol, **options: object) -> EvaluationResult:
    (folder / "out").mkdir(exist_ok=True)
    entry = EvaluationTask(
        "1",
        folder / "traj.txt",
        folder / "groundtruth.txt",
        folder / "out",
        protocol,
        artefacts=Artefacts.METRICS,
        **options,  # type: ignore[arg-type]
    )
    return run_task(entry, References())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, trajectory in (("groundtruth", TRUTH.trajectory), ("traj", ESTIMATE)):
        write_tum(tmp_path / f"{name}.txt", trajectory.stamps_s, trajectory.positions_m, trajectory.quats_xyzw)
    return tmp_path


@pytest.mark.parametrize("columns", [4, 8])
@pytest.mark.parametrize("alignment", [Alignment.NONE, Alignment.SE3, Alignment.SIM3])
def test_positions_alone_give_ate_and_no_rotation_figure(folder: Path, columns: int, alignment: Alignment) -> None:
    if columns == 4:
        rows = np.column_stack([TRUTH_S, TRUTH.trajectory.positions_m])
        np.savetxt(folder / "groundtruth.txt", rows, fmt="%.9f", header="t x y z")
    result = task(folder, Protocol(alignment), positions_only=columns == 8)
    assert result.reason is None
    assert result.metrics["ate.rmse"] < 1e-7
    parts = {key.split(".")[0] for key in result.metrics}
    assert not parts & {"ate_rot", "rpe", "rpe_rot", "kitti", "segment"}
    assert result.missing["ate_rot.rmse"] == result.missing["rpe.rmse"] == "the ground truth holds positions only"


@pytest.mark.integration
def test_the_lever_arm_of_a_prism_moves_the_estimate(folder: Path) -> None:
    sensor = move_sensor(ESTIMATE, LEVER_ARM)
    write_tum(folder / "traj.txt", sensor.stamps_s, sensor.positions_m, sensor.quats_xyzw)
    lever_arm = tuple(LEVER_ARM.ravel().tolist())
    protocol = Protocol(Alignment.SE3)
    assert task(folder, protocol, positions_only=True).metrics["ate.rmse"] > 0.01
    assert task(folder, protocol, positions_only=True, T_body_sensor=lever_arm).metrics["ate.rmse"] < 1e-7
    overridden = Protocol(Alignment.SE3, T_body_sensor=lever_arm)
    assert task(folder, overridden, positions_only=True).metrics["ate.rmse"] < 1e-7
    assert task(folder, overridden).metrics["ate.rmse"] < 1e-7
    back = Protocol(Alignment.SE3, T_body_sensor=IDENTITY4)
    assert task(folder, back, T_body_sensor=lever_arm).metrics["ate.rmse"] > 0.01
    refused = task(folder, Protocol(Alignment.SIM3), positions_only=True, T_body_sensor=lever_arm)
    assert (refused.reason or "").startswith("the alignment sim3 leaves the scale open")


def rows(stamps_s: list[float], positions_m: np.ndarray) -> str:
    return "".join(
        f"{t} {x} {y} {z} 0 0 0 1\n" for t, (x, y, z) in zip(stamps_s, np.asarray(positions_m).tolist(), strict=True)
    )


LINE = np.outer(np.arange(20.0), [1.0, 2.0, 0.5])


@pytest.mark.parametrize(
    ("protocol", "estimate", "reason"),
    [
        (Protocol(Alignment.SIM3), rows([1, 2, 3], np.eye(3)), "the alignment sim3 needs at least 4 matched poses"),
        (SE3, rows([1, 2], np.eye(3)[:2]), "only 2 of 2 estimated poses match the ground truth in time, at least 3"),
        (SE3, rows([1], np.eye(3)[:1]), "only 1 of 1 estimated poses match"),
        (SE3, "", "estimate traj.txt is empty"),
        (SE3, "# t x y z qx qy qz qw\n", "estimate traj.txt is empty"),
        (SE3, rows([3, 2, 1], np.eye(3)), "estimate traj.txt, line 2: timestamp 2.000000000 comes after 3.000000000"),
        (SE3, rows([1, 1, 2], np.eye(3)), "estimate traj.txt, line 2: timestamp 1.000000000 occurs twice"),
        (SE3, "1 nan 0 0 0 0 0 1\n", "estimate traj.txt, line 1: tx is nan"),
        (SE3, rows([500, 501, 502], np.eye(3)), "estimate and ground truth do not overlap in time"),
        (SE3, rows(list(range(20)), LINE), "alignment is not possible: the 20 matched poses lie on a straight line"),
        (Protocol(Alignment.SIM3), rows(list(range(20)), LINE), "alignment is not possible: the 20 matched poses lie"),
        (Protocol(Alignment.SCALE), rows(list(range(20)), LINE), "alignment is not possible: the 20 matched poses lie"),
        (
            Protocol(Alignment.YAW_POSITION),
            rows(list(range(20)), LINE * [0, 0, 1]),
            "yaw cannot be determined: the matched poses do not move in the horizontal plane",
        ),
        (
            Protocol(Alignment.SE3, align_poses=2),
            rows(list(range(20)), LINE),
            "the alignment se3 needs at least 3 matched poses, there are 2",
        ),
        (
            Protocol(Alignment.SE3, association=Association.INDEX),
            rows([1, 2, 3], np.eye(3)),
            "poses are matched by index, but the estimate has 3 and the ground truth 4000",
        ),
        (
            Protocol(Alignment.SE3, association=Association.INTERPOLATE, interpolation_interval_s=0.001),
            rows([1.005, 2.005, 3.005], np.eye(3)),
            "no estimated pose lies between ground-truth poses at most 0.001 s apart",
        ),
        (Protocol(Alignment.SE3, time_offset_s=100), rows([1, 2, 3], np.eye(3)), "estimate and ground truth do not"),
    ],
)
def test_what_cannot_be_evaluated_is_failed_with_one_line(
    folder: Path, protocol: Protocol, estimate: str, reason: str
) -> None:
    (folder / "traj.txt").write_text(estimate)
    result = task(folder, protocol)
    assert (result.reason or "").startswith(reason)
    assert "\n" not in (result.reason or "")
    assert result.metrics == {}


def test_a_line_is_evaluated_where_no_rotation_is_sought(folder: Path) -> None:
    (folder / "traj.txt").write_text(rows(list(range(20)), LINE))
    for alignment in (Alignment.NONE, Alignment.FIRST_POSE, Alignment.YAW_POSITION):
        assert task(folder, Protocol(alignment)).reason is None


@pytest.mark.parametrize(
    "protocol",
    [
        Protocol(Alignment.FIRST_POSE),
        Protocol(Alignment.SE3, align_poses=1),
        Protocol(Alignment.YAW_POSITION, align_poses=1),
    ],
)
def test_positions_alone_have_no_first_pose(folder: Path, protocol: Protocol) -> None:
    result = task(folder, protocol, positions_only=True)
    assert (result.reason or "").startswith("alignment of the first pose needs orientations")


def test_a_stretch_of_the_truth_is_left_out_and_said() -> None:
    wrong = flight(TRUTH_S)
    positions_m = wrong.positions_m.copy()
    positions_m[(TRUTH_S >= 10) & (TRUTH_S <= 12)] += [0.0, 0.0, 0.5]
    truth = TruthReference(Trajectory(TRUTH_S, positions_m, wrong.quats_xyzw))
    protocol = replace(SE3, leave_out_s=(10.0, 12.0, 30.0, 30.5))
    assert figures(pair(truth, ESTIMATE, SE3))["ate.rmse"] > 0.05
    found = pair(truth, ESTIMATE, protocol)
    assert figures(found)["ate.rmse"] == pytest.approx(0, abs=2e-3)
    assert figures(pair(truth, ESTIMATE, replace(SE3, leave_out_s=(12.0, 14.0))))["ate.rmse"] > 0.05
    stamps_s = found.matched_reference.stamps_s
    assert not np.any((stamps_s >= 10) & (stamps_s <= 12))
    assert "without 10.000 to 12.000 s and 30.000 to 30.500 s" in protocol.label
    with pytest.raises(InvalidInput, match="leaves out the whole ground truth"):
        pair(truth, ESTIMATE, replace(SE3, leave_out_s=(-1.0, 50.0)))
    with pytest.raises(InvalidInput, match="two timestamps for each stretch"):
        replace(SE3, leave_out_s=(1.0, 2.0, 1.5, 3.0))


def test_a_prism_is_where_the_dataset_says(tmp_path: Path) -> None:
    arm_m = (0.3, -0.2, 0.8)
    T = np.eye(4)
    T[:3, 3] = arm_m
    prism = move_sensor(flight(TRUTH_S), T)
    np.savetxt(tmp_path / "prism.txt", np.column_stack([prism.stamps_s, prism.positions_m]), fmt="%.9f")
    camera = move_sensor(ESTIMATE, LEVER_ARM)
    write_tum(tmp_path / "estimate.txt", camera.stamps_s, camera.positions_m, camera.quats_xyzw)
    task = EvaluationTask(
        "1",
        tmp_path / "estimate.txt",
        tmp_path / "prism.txt",
        tmp_path,
        SE3,
        T_body_sensor=tuple(LEVER_ARM.ravel()),
        lever_arm_m=arm_m,
    )
    assert run_task(task, References()).metrics["ate.rmse"] < 1e-6
    assert run_task(replace(task, lever_arm_m=None), References()).metrics["ate.rmse"] > 0.05
    stated = replace(task, lever_arm_m=None, protocol=replace(SE3, lever_arm_m=arm_m))
    assert run_task(stated, References()).metrics["ate.rmse"] < 1e-6
    fitted = run_task(
        replace(task, lever_arm_m=None, protocol=replace(SE3, frame_fit=FrameFit.LEVER_ARM)), References()
    )
    assert fitted.metrics["ate.rmse"] < 1e-6
    assert fitted.metrics["alignment.lever_arm"] == pytest.approx(float(np.linalg.norm(arm_m)), abs=1e-5)
    (hint,) = (hint for hint in fitted.hints if hint.key == "frame_fitted")
    assert "lever_arm_m: [0.300, -0.200, 0.800]" in hint.remedy
