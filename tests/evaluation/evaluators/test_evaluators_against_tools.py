"""Metrics of recorded runs against evo, the KITTI devkit's golden values, and the relations of a recorded building."""

import bz2
import math
from pathlib import Path

import numpy as np
import pytest
from evo.core import filters
from evo.core.metrics import APE, RPE, PoseRelation, Unit
from evo.core.trajectory import PoseTrajectory3D

from slamhive.domain.protocol import Alignment, Protocol, RpePairs
from slamhive.evaluation.evaluators.base import Paired
from slamhive.evaluation.evaluators.completeness import StartEndDrift
from slamhive.evaluation.evaluators.evo_errors import RotationError
from slamhive.evaluation.evaluators.relations import read_relations, relation_errors
from slamhive.evaluation.evaluators.relative import RelativeErrors
from slamhive.evaluation.evaluators.segments import KittiProtocol, kitti_segments, mean_as_devkit
from slamhive.trajectory.kitti import read_kitti
from slamhive.trajectory.layout import parse_tum
from slamhive.trajectory.model import Poses, Trajectory
from tests.evaluation.evaluators.curves import SE3, paired

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
EVO, RUNS, ACES = DATA / "evo_trajectories", DATA / "euroc_vio_runs", DATA / "radish_aces_2d"

pytestmark = [
    pytest.mark.shared_data,
    pytest.mark.integration,
    pytest.mark.skipif(not RUNS.is_dir(), reason="the recorded data is not in ../shared/data"),
]


def tum(path: Path) -> Trajectory:
    return parse_tum(path.read_bytes(), path.name)


def kitti(name: str) -> Trajectory:
    return read_kitti(EVO / f"KITTI_00_{name}.txt", EVO / "KITTI_00_gt_times.txt")


def euroc(protocol: Protocol = SE3) -> Paired:
    return paired(tum(RUNS / "MH_01" / "groundtruth.txt"), tum(RUNS / "vio_mono" / "MH_01" / "0.txt"), protocol)


def as_evo(poses: Poses) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses.positions_m, np.roll(poses.quats_xyzw, 1, axis=1), poses.stamps_s)


def matrices(name: str) -> np.ndarray:
    """The matrices of a KITTI file as they stand there, with seven digits, not made orthonormal."""
    rows = np.loadtxt(EVO / f"KITTI_00_{name}.txt").reshape(-1, 3, 4)
    return np.concatenate((rows, np.broadcast_to([[[0.0, 0.0, 0.0, 1.0]]], (len(rows), 1, 4))), axis=1)


def test_kitti_protocol_equals_the_devkit():
    found = kitti_segments(matrices("gt"), matrices("ORB"))
    assert len(found.lengths_m) == 3283
    assert round(100 * mean_as_devkit(found.translations), 6) == 0.699734
    assert round(np.rad2deg(mean_as_devkit(found.rotations_radpm)), 8) == 0.00253352
    by_length = [mean_as_devkit(found.translations[found.lengths_m == length]) for length in range(100, 900, 100)]
    percents = [round(100 * error, 4) for error in by_length]
    assert percents == [1.0091, 0.8744, 0.7809, 0.7189, 0.6553, 0.5720, 0.4926, 0.4159]
    counts = [int((found.lengths_m == length).sum()) for length in range(100, 900, 100)]
    assert counts == [445, 431, 424, 416, 408, 399, 385, 375]


def test_kitti_figures_of_trajectories_differ_by_their_orthonormal_rotations():
    values = KittiProtocol().evaluate(paired(kitti("gt"), kitti("ORB"))).values
    assert values["kitti.segments"] == 3283
    assert round(values["kitti.translation"], 6) == 0.699734
    assert values["kitti.rotation"] == pytest.approx(0.00253352, rel=5e-5)
    assert values["kitti.translation.800m"] == pytest.approx(0.4159, abs=5e-5)


def test_rotation_error_equals_evo():
    pair = euroc()
    ape = APE(PoseRelation.rotation_angle_deg)
    ape.process_data((as_evo(pair.matched_reference), as_evo(pair.aligned)))
    values = RotationError().evaluate(pair).values
    for name, value in values.items():
        assert value == pytest.approx(ape.get_all_statistics()[name.split(".")[1]], rel=1e-7), name


BY_METRES, BY_FRAMES, BY_DEGREES = ("", Unit.meters, 1.0), (".frames", Unit.frames, 1), (".degrees", Unit.degrees, 10.0)


@pytest.mark.parametrize(
    ("part", "by", "pairs"),
    [
        ("rpe_rot", BY_METRES, RpePairs.ALL),
        ("rpe_rot", BY_METRES, RpePairs.CONSECUTIVE),
        ("rpe", BY_FRAMES, RpePairs.ALL),
        ("rpe_rot", BY_FRAMES, RpePairs.ALL),
        ("rpe", BY_FRAMES, RpePairs.CONSECUTIVE),
        ("rpe", BY_DEGREES, RpePairs.CONSECUTIVE),
        ("rpe_rot", BY_DEGREES, RpePairs.CONSECUTIVE),
    ],
)
def test_relative_errors_equal_evo(part: str, by: tuple[str, Unit, float], pairs: RpePairs) -> None:
    ending, unit, delta = by
    pair = euroc(Protocol(Alignment.SIM3, rpe_pairs=pairs))
    relation = PoseRelation.translation_part if part == "rpe" else PoseRelation.rotation_angle_deg
    rpe = RPE(relation, delta, unit, all_pairs=pairs is RpePairs.ALL)
    rpe.process_data((as_evo(pair.matched_reference), as_evo(pair.aligned)))
    expected, values = rpe.get_all_statistics(), RelativeErrors().evaluate(pair).values
    for name in ("rmse", "median", "max"):
        assert values[f"{part}{ending}.{name}"] == pytest.approx(expected[name], rel=1e-6, abs=1e-9), name


def test_pairs_by_frames_further_apart_equal_evo():
    pair = euroc(Protocol(Alignment.SE3, rpe_pairs=RpePairs.CONSECUTIVE, rpe_delta_frames=7))
    pairs = filters.filter_pairs_by_index(as_evo(pair.aligned).poses_se3, 7, all_pairs=False)
    rpe = RPE(PoseRelation.translation_part, 7, Unit.frames, all_pairs=False)
    rpe.process_data((as_evo(pair.matched_reference), as_evo(pair.aligned)))
    assert len(rpe.error) == len(pairs)
    values = RelativeErrors().evaluate(pair).values
    assert values["rpe.frames.rmse"] == pytest.approx(rpe.get_all_statistics()["rmse"], rel=1e-9)


def test_drift_of_a_real_run_whose_middle_has_no_ground_truth():
    truth = tum(RUNS / "MH_01" / "groundtruth.txt")
    share = (truth.stamps_s - truth.stamps_s[0]) / truth.span_s
    ends = np.flatnonzero((share < 0.3) | (share > 0.7)).astype(np.intp)
    part = truth.take(ends)
    estimate = tum(RUNS / "vio_stereo" / "MH_01" / "0.txt")
    pair = paired(Trajectory(part.stamps_s, part.positions_m, part.quats_xyzw), estimate)
    values = StartEndDrift().evaluate(pair).values
    assert 0 < values["drift.alignment"] < 1.0
    assert 0 < values["drift.rotation"] < 10.0
    assert 0 < values["drift.end"] < 2.0


def aces_odometry() -> np.ndarray:
    """Stamp, x, y, heading of the wheel odometry, at each scan."""
    lines = bz2.decompress((ACES / "aces.clf.bz2").read_bytes()).decode().splitlines()
    words = [line.split() for line in lines if line.startswith("FLASER ")]
    return np.array([[row[-3], row[-6], row[-5], row[-4]] for row in words], dtype=float)


def test_odometry_of_a_building_against_its_relations():
    """The stamps are those of the relations; the errors are taken once more by hand, in the plane."""
    rows = aces_odometry()
    zero, half = np.zeros(len(rows)), rows[:, 3] / 2
    quats = np.column_stack([zero, zero, np.sin(half), np.cos(half)])
    estimate = Trajectory(rows[:, 0], np.column_stack([rows[:, 1:3], zero]), quats)
    values = relation_errors(read_relations(ACES / "aces.relations"), estimate, 1.0)
    assert values["relations.matched_fraction"] == 1.0

    at = {stamp: (x, y, heading) for stamp, x, y, heading in rows}
    distances_m, angles_rad = [], []
    for first, second, x, y, _, _, _, yaw in np.loadtxt(ACES / "aces.relations"):
        (x1, y1, h1), (x2, y2, h2) = at[first], at[second]
        ahead = math.cos(h1) * (x2 - x1) + math.sin(h1) * (y2 - y1)
        left = -math.sin(h1) * (x2 - x1) + math.cos(h1) * (y2 - y1)
        distances_m.append(math.hypot(ahead - x, left - y))
        angles_rad.append(abs(math.remainder(h2 - h1 - yaw, math.tau)))
    assert len(distances_m) == 1279
    assert values["relations.translation.mean"] == pytest.approx(np.mean(distances_m), rel=1e-9)
    assert values["relations.translation.std"] == pytest.approx(np.std(distances_m), rel=1e-9)
    assert values["relations.rotation.mean"] == pytest.approx(np.rad2deg(np.mean(angles_rad)), rel=1e-9)
    assert values["relations.rotation.max"] == pytest.approx(np.rad2deg(np.max(angles_rad)), rel=1e-9)
