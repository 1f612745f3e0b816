"""Common mistakes, made on purpose in real trajectories, are told with their remedy; clean runs are told nothing."""

import functools
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.domain.protocol import Alignment, Association, FrameFit, Protocol
from slamhive.domain.verdict import Hint
from slamhive.evaluation.evaluators.base import UNCERTAINTIES, Paired
from slamhive.evaluation.evaluators.completeness import AppliedAlignment, TruthFloor
from slamhive.evaluation.evaluators.evo_errors import RotationError
from slamhive.evaluation.hints import find_hints, rms_m
from slamhive.evaluation.pairing import pair
from slamhive.evaluation.references import TruthReference
from slamhive.trajectory.kitti import read_kitti
from slamhive.trajectory.layout import read_tum as read_tum_file
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import interpolate, inverse_quats, move_sensor, multiply_quats, rotations_from_quats

DATA = project_root().parent / "shared" / "data"
RUNS, EVO, ROAD = DATA / "euroc_vio_runs", DATA / "evo_trajectories", DATA / "kitti06_stereo_51"
SE3, SIM3, YAW = (Protocol(entry) for entry in (Alignment.SE3, Alignment.SIM3, Alignment.YAW_POSITION))

pytestmark = [
    pytest.mark.integration,
    pytest.mark.shared_data,
    pytest.mark.skipif(not RUNS.is_dir(), reason="the recorded data is not in ../shared/data"),
]

Change = Callable[[Trajectory], Trajectory]

read_tum = functools.cache(read_tum_file)
"""Most tests read the same flights."""


def hints(truth: Trajectory, estimate: Trajectory, protocol: Protocol, *, rotations: bool = True) -> dict[str, Hint]:
    paired = pair(TruthReference(truth, rotations), estimate, protocol)
    found = find_hints(paired, {"ate.rmse": error_m(paired)})
    assert len({hint.key for hint in found}) == len(found)
    return {hint.key: hint for hint in found}


def error_m(paired: Paired) -> float:
    """The ATE (RMSE); evo's code for it takes longer than all the rest."""
    return rms_m(paired.aligned.positions_m - paired.matched_reference.positions_m)


def kitti(name: str) -> Trajectory:
    return read_kitti(EVO / f"KITTI_00_{name}.txt", EVO / "KITTI_00_gt_times.txt")


def flights(trial: str) -> Iterator[tuple[str, Trajectory, Trajectory]]:
    for path in sorted(RUNS.glob(f"v*/*/{trial}.txt")):
        yield "/".join(path.parts[-3:]), read_tum(RUNS / path.parts[-2] / "groundtruth.txt"), read_tum(path)


@pytest.mark.parametrize("trial", range(5))
def test_clean_flights_are_told_nothing(trial: int) -> None:
    """All 122 runs of four systems, the diverging ones too."""
    for name, truth, estimate in flights(str(trial)):
        for protocol in (YAW, SE3, SIM3):
            found = hints(truth, estimate, protocol)
            # The orientations of this ground truth are known to be off by 5 degrees; two of the systems show it.
            assert {*found} <= ({"frame_offset"} if "V1_01" in name else set()), (name, protocol.label)
        assert hints(truth, estimate, SE3, rotations=False) == {}, name


def test_other_clean_runs_are_told_nothing() -> None:
    for protocol in (SE3, SIM3, replace(SE3, association=Association.INDEX)):
        assert hints(kitti("gt"), kitti("ORB"), protocol) == {}
    truth = read_tum(EVO / "freiburg1_xyz-groundtruth.txt")
    for protocol in (SE3, SIM3, replace(SE3, association=Association.HOLD)):
        assert hints(truth, read_tum(EVO / "freiburg1_xyz-rgbdslam.txt"), protocol) == {}
    assert hints(truth, read_tum(EVO / "freiburg1_xyz-ORB_kf_mono.txt"), SIM3) == {}


# -- mistakes ----------------------------------------------------------------------------------------------------------


def rolled(places: int) -> Change:
    return lambda t: Trajectory(t.stamps_s, t.positions_m, np.roll(t.quats_xyzw, places, axis=1))


def inverted(t: Trajectory) -> Trajectory:
    positions_m = -np.einsum("nji,nj->ni", rotations_from_quats(t.quats_xyzw), t.positions_m)
    return Trajectory(t.stamps_s, positions_m, inverse_quats(t.quats_xyzw))


def turned_back(t: Trajectory) -> Trajectory:
    return Trajectory(t.stamps_s, t.positions_m, inverse_quats(t.quats_xyzw))


def left_handed(axis: int, *, turning: bool) -> Change:
    signs = np.where(np.arange(3) == axis, -1.0, 1.0)
    turns = np.append(-signs, 1.0) if turning else np.ones(4)
    return lambda t: Trajectory(t.stamps_s, t.positions_m * signs, t.quats_xyzw * turns)


def world_turned(*quat_xyzw: float) -> Change:
    quat = np.array([quat_xyzw]) / np.linalg.norm(quat_xyzw)
    rotation = rotations_from_quats(quat)[0]
    return lambda t: Trajectory(t.stamps_s, t.positions_m @ rotation.T, multiply_quats(quat, t.quats_xyzw))


def scaled(factor: float) -> Change:
    return lambda t: Trajectory(t.stamps_s, t.positions_m * factor, t.quats_xyzw)


def later(delay_s: float) -> Change:
    return lambda t: Trajectory(t.stamps_s + delay_s, t.positions_m, t.quats_xyzw)


@functools.cache
def is_poor(truth: Trajectory, estimate: Trajectory) -> bool:
    """Its error is a tenth of the path's size: a mistake makes it worse, but not by much."""
    paired = pair(TruthReference(truth), estimate, SIM3)
    size_m = np.sqrt(
        np.mean(np.sum((paired.matched_reference.positions_m - truth.positions_m.mean(axis=0)) ** 2, axis=1))
    )
    return bool(error_m(paired) > 0.1 * size_m)


MISTAKES: dict[str, tuple[str, Change]] = {
    "w first, read as x": ("quaternion_order", rolled(1)),
    "x first, read as w": ("quaternion_order", rolled(-1)),
    "inverse poses": ("inverse_poses", inverted),
    "inverse rotations": ("inverse_rotations", turned_back),
    "y mirrored": ("mirrored_axes", left_handed(1, turning=False)),
    "z mirrored": ("mirrored_axes", left_handed(2, turning=False)),
    "a left-handed world": ("mirrored_axes", left_handed(0, turning=True)),
    "millimetres": ("scale", scaled(1000.0)),
    "kilometres": ("scale", scaled(0.001)),
    "centimetres": ("scale", scaled(100.0)),
    "late": ("time_offset", later(0.5)),
    "early": ("time_offset", later(-1.5)),
}


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("protocol", [YAW, SE3, SIM3], ids=lambda protocol: protocol.alignment.value)
def test_each_mistake_is_told_of_every_system_and_sequence(mistake: str, protocol: Protocol) -> None:
    key, change = MISTAKES[mistake]
    if mistake == "centimetres" and protocol is SIM3:
        return  # the scale of one camera may be anything
    for name, truth, estimate in flights("0"):
        if is_poor(truth, estimate) or (protocol is not YAW and "/V2_" not in name):
            continue
        found = hints(truth, change(estimate), protocol)
        if key == "time_offset" and name.startswith("vislam_ba"):
            assert set(found) <= {key}, "some of its keyframes are too far apart to tell a clock"
        else:
            assert set(found) == {key}, (name, found)


@pytest.mark.parametrize(
    ("mistake", "remedy"),
    [("w first, read as x", "--groundtruth-quaternion-order wxyz"), ("inverse poses", "import the dataset again")],
)
def test_a_mistake_of_the_ground_truth_is_told_as_one(mistake: str, remedy: str) -> None:
    key, change = MISTAKES[mistake]
    for name, truth, estimate in flights("1"):
        found = hints(change(truth), estimate, SE3)
        assert set(found) == {key}, name
        assert "the ground truth seem to" in found[key].sentence
        assert remedy in found[key].remedy


def test_a_mistake_of_the_estimate_is_told_with_its_numbers() -> None:
    truth, estimate = read_tum(RUNS / "V2_01/groundtruth.txt"), read_tum(RUNS / "vio_stereo/V2_01/0.txt")
    found = hints(truth, rolled(1)(estimate), SE3)["quaternion_order"]
    assert found.sentence.startswith("The quaternions of the estimate")
    assert "the orientations follow the ground truth to 0." in found.sentence
    assert "--quaternion-order wxyz" in found.remedy


@pytest.mark.parametrize(("quat", "tilt_deg"), [((1, 0, 0, 0), 180), ((1, 0, 0, 1), 90), ((0.2, -0.3, 0, 1), 40)])
def test_a_z_axis_that_does_not_point_up_is_told_where_gravity_counts(quat: tuple[float, ...], tilt_deg: int) -> None:
    for name, truth, estimate in flights("0"):
        if is_poor(truth, estimate):
            continue
        turned = world_turned(*quat)(estimate)
        found = hints(truth, turned, YAW)
        assert set(found) == {"gravity"}, (name, found)
        shown_deg = re.search(r"tilted by (\d+) deg", found["gravity"].sentence)
        assert shown_deg is not None
        assert int(shown_deg[1]) == pytest.approx(tilt_deg, abs=8), name
        assert set(hints(truth, turned, SE3)) <= ({"frame_offset"} if "V1_01" in name else set()), name


def test_planar_runs_tell_by_their_orientations() -> None:
    """A car turns about one axis only: positions alone could be mirrored or turned over."""
    truth, estimate = kitti("gt"), kitti("ORB")
    for protocol in (SE3, replace(SE3, association=Association.INDEX)):
        assert set(hints(truth, rolled(1)(estimate), protocol)) == {"quaternion_order"}
        assert set(hints(truth, inverted(estimate), protocol)) == {"inverse_poses"}
        assert set(hints(truth, scaled(1000.0)(estimate), protocol)) == {"scale"}
    tolerant = replace(SE3, association_tolerance_s=0.06)
    assert set(hints(truth, later(2.0)(estimate), tolerant)) == {"time_offset"}


def test_a_slow_hand_held_run_tells_too() -> None:
    truth, estimate = (read_tum(EVO / f"freiburg1_xyz-{name}.txt") for name in ("groundtruth", "rgbdslam"))
    assert set(hints(truth, rolled(1)(estimate), SE3)) == {"quaternion_order"}
    assert set(hints(truth, inverted(estimate), SE3)) == {"inverse_poses"}
    assert set(hints(truth, later(0.3)(estimate), SE3)) == {"time_offset"}
    assert set(hints(truth, scaled(1000.0)(estimate), SE3)) == {"scale"}


def test_without_orientations_positions_tell() -> None:
    truth, estimate = read_tum(RUNS / "V2_01/groundtruth.txt"), read_tum(RUNS / "vio_stereo/V2_01/0.txt")
    for key, change in (("mirrored_axes", left_handed(1, turning=False)), ("scale", scaled(1000.0))):
        assert set(hints(truth, change(estimate), SE3, rotations=False)) == {key}
    assert set(hints(truth, later(0.5)(estimate), SE3, rotations=False)) == {"time_offset"}


def test_two_mistakes_are_both_told() -> None:
    _, truth, estimate = next(iter(flights("0")))
    assert set(hints(truth, scaled(1000.0)(rolled(1)(estimate)), SE3)) == {"quaternion_order", "scale"}


def test_an_offset_is_not_told_where_it_is_searched() -> None:
    _, truth, estimate = next(iter(flights("0")))
    late = later(0.5)(estimate)
    found = hints(truth, late, SE3)["time_offset"]
    assert found.sentence.startswith("The clock of the estimate is 0.500 s late: with -0.500 s added")
    assert found.remedy == "evaluate under a protocol with offset_search_s: 1, or with time_offset_s: -0.500"
    assert hints(truth, late, replace(SE3, offset_search_s=1.0)) == {}
    assert hints(truth, late, replace(SE3, time_offset_s=-0.5)) == {}


# -- straight paths ----------------------------------------------------------------------------------------------------


def test_a_nearly_straight_road_is_told_with_how_much_it_leaves_open() -> None:
    """Noise of centimetres on a road that strays by as little: alignment rolls it by tens of degrees."""
    t = np.arange(0.0, 60.0, 0.1)
    rng = np.random.default_rng(4)
    truth = Trajectory(
        t, np.column_stack([t, 0.03 * np.sin(t / 7), 0.02 * np.sin(t / 11)]), np.tile([0, 0, 0, 1.0], (600, 1))
    )
    estimate = Trajectory(t, truth.positions_m + np.cumsum(rng.normal(0, 0.006, (600, 3)), axis=0), truth.quats_xyzw)
    found = hints(truth, estimate, SE3)
    assert set(found) == {"straight_path"}
    told_deg = re.search(r"about that line by up to about (\d+) deg", found["straight_path"].sentence)
    assert told_deg is not None
    R = pair(TruthReference(truth), estimate, SE3).transform.rotation
    rolled_deg = np.rad2deg(abs(np.arctan2(R[2, 1], R[2, 2])))
    assert 10 < rolled_deg < 1.2 * int(told_deg[1]), "it was turned so far, and is said to be turned further at most"
    assert hints(truth, estimate, YAW) == {}


def test_the_first_seconds_of_a_kitti_road_are_measured_not_guessed() -> None:
    truth = read_tum(ROAD / "groundtruth_tum.txt")
    noise_m = np.random.default_rng(1).normal(0, 0.03, (len(truth), 3))
    estimate = Trajectory(truth.stamps_s, truth.positions_m + noise_m, truth.quats_xyzw)
    found = hints(truth, estimate, SE3)
    assert set(found) == {"straight_path"}
    assert "it strays 0.044 m from a line, and the position error is 0.044 m" in found["straight_path"].sentence
    assert hints(truth, estimate, replace(SE3, alignment=Alignment.FIRST_POSE)) == {}


# -- time units --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_no_overlap_suggests_the_unit_that_would_fit(unit: str, factor: float) -> None:
    _, truth, estimate = next(iter(flights("0")))
    wrong = Trajectory(estimate.stamps_s * factor, estimate.positions_m, estimate.quats_xyzw)
    with pytest.raises(InvalidInput, match=f"of the estimate look like {unit}, not seconds.*--time-unit {unit}"):
        pair(TruthReference(truth), wrong, SE3)
    other = Trajectory(truth.stamps_s * factor, truth.positions_m, truth.quats_xyzw)
    with pytest.raises(InvalidInput, match=f"of the ground truth look like {unit}.*--groundtruth-time-unit {unit}"):
        pair(TruthReference(other), estimate, SE3)


def test_a_unit_that_makes_times_overlap_a_little_is_told() -> None:
    """Milliseconds from zero, taken for seconds, last a thousand times as long: few poses match, and wrongly."""
    t = np.arange(0.0, 100.0, 0.05)
    positions_m = np.column_stack([3 * np.cos(t), 2 * np.sin(2 * t), np.sin(t / 3)])
    quats = np.tile([0, 0, 0, 1.0], (len(t), 1))
    truth = Trajectory(t, positions_m, quats)
    found = hints(truth, Trajectory(t * 1e3, positions_m, quats), replace(SE3, association_tolerance_s=0.1))
    assert set(found) == {"time_unit"}
    assert "look like ms, not seconds" in found["time_unit"].sentence


# -- frames ------------------------------------------------------------------------------------------------------------

ANTENNA_M = np.array([0.6, -0.3, 1.2])


def mounted(R_xyzw: tuple[float, ...], arm_m: np.ndarray) -> Change:
    """The trajectory of another frame on the same body."""
    T = np.eye(4)
    T[:3, :3] = rotations_from_quats(np.array([R_xyzw]) / np.linalg.norm(R_xyzw))[0]
    T[:3, 3] = arm_m
    return lambda t: move_sensor(t, T)


def flight_of(name: str) -> tuple[Trajectory, Trajectory]:
    return read_tum(RUNS / "V2_02" / "groundtruth.txt"), read_tum(RUNS / name / "V2_02" / "0.txt")


@pytest.mark.parametrize("system", ["vio_mono", "vio_stereo", "vislam_ba", "vislam_rp"])
@pytest.mark.parametrize("protocol", [SE3, YAW])
def test_the_frame_of_another_sensor_is_told_with_its_transform(system: str, protocol: Protocol) -> None:
    truth, estimate = flight_of(system)
    camera = mounted((0.5, -0.5, 0.5, -0.5), ANTENNA_M)
    found = hints(truth, camera(estimate), protocol)
    assert set(found) == {"frame_offset"}
    hint = found["frame_offset"]
    assert re.search(r"constant rotation of 1(19|20)\.\d \+- 0\.\d+ deg", hint.sentence)
    numbers = [float(text) for text in re.search(r"T_body_sensor: \[(.*?)\]", hint.remedy)[1].split(", ")]  # type: ignore[index]
    corrected = replace(protocol, T_body_sensor=tuple(numbers))
    reference = TruthReference(move_sensor(truth, np.reshape(numbers, (4, 4))))
    paired = pair(reference, camera(estimate), corrected)
    assert find_hints(paired, {"ate.rmse": error_m(paired)}) == ()
    assert np.array(numbers).reshape(4, 4)[:3, 3] == pytest.approx(ANTENNA_M, abs=0.12)


def test_a_turned_frame_alone_is_told_though_the_position_error_is_small() -> None:
    truth, estimate = flight_of("vislam_ba")
    found = hints(truth, mounted((0, 0, 1, 0.01), np.zeros(3))(estimate), SE3)
    assert re.search(r"17[89]\.\d \+- 0\.\d+ deg, from which they stray by 0\.\d deg", found["frame_offset"].sentence)


@pytest.mark.parametrize("system", ["vio_mono", "vio_stereo", "vislam_ba", "vislam_rp"])
def test_an_antenna_is_told_where_the_truth_has_positions_only(system: str) -> None:
    truth, estimate = flight_of(system)
    antenna = mounted((0, 0, 0, 1), ANTENNA_M)(truth)
    found = hints(antenna, estimate, SE3, rotations=False)["frame_offset"]
    arm_m = [float(text) for text in re.search(r"lever_arm_m: \[(.*?)\]", found.remedy)[1].split(", ")]  # type: ignore[index]
    assert arm_m == pytest.approx(ANTENNA_M, abs=0.12)
    said = re.search(r"falls from ([\d.]+) m to ([\d.]+) m", found.sentence)
    assert said is not None
    if system == "vislam_ba":
        assert float(said[1]) > 10 * float(said[2])


@pytest.mark.parametrize("fit", list(FrameFit))
def test_a_fitted_frame_is_reported_and_no_longer_an_error(fit: FrameFit) -> None:
    truth, estimate = flight_of("vislam_ba")
    camera = mounted((0.5, -0.5, 0.5, -0.5), ANTENNA_M)(estimate)
    protocol = replace(SE3, frame_fit=fit)
    paired = pair(TruthReference(truth), camera, protocol)
    metrics = {**AppliedAlignment().evaluate(paired).values, **RotationError().evaluate(paired).values}
    said = {hint.key: hint for hint in find_hints(paired, {"ate.rmse": error_m(paired)})}
    assert "frame_fitted" in said
    if fit is not FrameFit.LEVER_ARM:
        # Without the arm the worlds are aligned less well, and so is what is left between the frames.
        assert metrics["alignment.frame_rotation"] == pytest.approx(120, abs=0.7 if fit is FrameFit.POSE else 5)
        assert 0 < metrics["alignment.frame_rotation_sigma"] < 1
        assert metrics["ate_rot.rmse"] < 3
    if fit is not FrameFit.ROTATION:
        length_m = float(np.linalg.norm(ANTENNA_M))
        sigma_m = metrics["alignment.lever_arm_sigma"]
        assert metrics["alignment.lever_arm"] == pytest.approx(length_m, abs=max(3 * sigma_m, 0.05))
        assert error_m(paired) < 0.06
    assert protocol.label.count("fitted") == 1


def test_a_sparse_truth_is_told_with_the_rule_that_fits() -> None:
    truth, estimate = flight_of("vio_stereo")
    between_s = 0.5 * (estimate.stamps_s[5:-5:20] + estimate.stamps_s[6:-4:20])
    rare = interpolate(truth, between_s[(between_s > truth.stamps_s[0]) & (between_s < truth.stamps_s[-1])])
    sparse = Trajectory(rare.stamps_s, rare.positions_m, rare.quats_xyzw)
    with pytest.raises(InvalidInput, match=r"association: interpolate_estimate.* matches \d+ of the \d+ poses"):
        pair(TruthReference(sparse), estimate, replace(SE3, association_tolerance_s=0.002))
    by_estimate = pair(TruthReference(sparse), estimate, replace(SE3, association=Association.INTERPOLATE_ESTIMATE))
    assert len(by_estimate.matched_reference) >= 0.9 * len(sparse)
    moved_s = np.where(np.arange(len(sparse)) % 3 == 0, sparse.stamps_s + 0.024, sparse.stamps_s)
    third = interpolate(truth, moved_s)
    few = pair(TruthReference(Trajectory(moved_s, third.positions_m, third.quats_xyzw)), estimate, SE3)
    assert {hint.key for hint in find_hints(few, {"ate.rmse": 0.1})} == {"sparse_truth"}


def test_an_error_near_the_uncertainty_of_the_truth_is_told(tmp_path: Path) -> None:
    truth, estimate = flight_of("vislam_ba")
    paired = pair(TruthReference(truth), estimate, SE3, uncertainty_m=0.03)
    floor = TruthFloor().evaluate(paired).values
    assert floor == {"ate.truth_floor": pytest.approx(0.03 * np.sqrt(3))}
    found = {hint.key for hint in find_hints(paired, {"ate.rmse": error_m(paired), **floor})}
    assert found == {"truth_floor"}
    rows = np.column_stack([truth.stamps_s, np.full((len(truth), 3), [0.01, 0.02, 0.02])])
    np.savetxt(tmp_path / "sigmas.txt", rows, fmt="%.9f")
    of_poses = pair(TruthReference(truth), estimate, SE3, {UNCERTAINTIES: tmp_path / "sigmas.txt"}, uncertainty_m=1.0)
    assert TruthFloor().evaluate(of_poses).values == {"ate.truth_floor": pytest.approx(0.03)}
    np.savetxt(tmp_path / "sigmas.txt", rows[:100], fmt="%.9f")
    with pytest.raises(InvalidInput, match=r"sigmas\.txt does not cover the ground truth"):
        TruthFloor().evaluate(of_poses)
