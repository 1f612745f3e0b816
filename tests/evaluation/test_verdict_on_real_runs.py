"""The rule of failure on published runs: sound ones pass, whatever their spacing; lost and diverged ones fail."""

from collections import Counter

import numpy as np
import pytest

from slamhive.base.project import project_root
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.domain.verdict import Verdict, VerdictKind, compare_repeats, judge, tracked_enough
from slamhive.evaluation.evaluators.completeness import TrackingCoverage
from slamhive.evaluation.evaluators.evo_errors import RelativeSize
from slamhive.evaluation.pairing import pair
from slamhive.evaluation.references import TruthReference
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.model import Trajectory

SHARED = project_root().parent / "shared" / "data"
RUNS, EVO = SHARED / "euroc_vio_runs", SHARED / "evo_trajectories"
SYSTEMS = {"vio_mono": 6, "vio_stereo": 6, "vislam_ba": 55, "vislam_rp": 55}

pytestmark = [
    pytest.mark.shared_data,
    pytest.mark.integration,
    pytest.mark.skipif(not RUNS.is_dir(), reason="the recorded runs are not in ../shared/data/euroc_vio_runs"),
]


def evidence(
    truth: TruthReference, estimate: Trajectory, alignment: Alignment = Alignment.YAW_POSITION
) -> dict[str, float]:
    paired = pair(truth, estimate, Protocol(alignment))
    errors_m = np.linalg.norm(paired.aligned.positions_m - paired.matched_reference.positions_m, axis=1)
    found = {**TrackingCoverage().evaluate(paired).values, **RelativeSize().evaluate(paired).values}
    return {**found, "ate.rmse": float(np.sqrt(np.mean(errors_m**2)))}


def part(trajectory: Trajectory, kept: np.ndarray) -> Trajectory:
    chosen = np.flatnonzero(kept)
    return Trajectory(trajectory.stamps_s[chosen], trajectory.positions_m[chosen], trajectory.quats_xyzw[chosen])


@pytest.fixture(scope="module")
def truths():
    return {path.parent.name: TruthReference(read_tum(path)) for path in RUNS.glob("*/groundtruth.txt")}


@pytest.fixture(scope="module")
def estimates():
    found = {}
    for system in SYSTEMS:
        for path in sorted(RUNS.glob(f"{system}/*/*.txt")):
            found[system, path.parent.name, int(path.stem)] = read_tum(path)
    return found


@pytest.fixture(scope="module")
def measured(truths, estimates):
    return {key: evidence(truths[key[1]], estimate) for key, estimate in estimates.items()}


def verdicts(measured):
    """{run: verdict} as an installation with all these runs has it."""
    found: dict[tuple[str, str, int], Verdict] = {}
    for system, sequence in {key[:2] for key in measured}:
        runs = {key: metrics for key, metrics in measured.items() if key[:2] == (system, sequence)}
        errors_m = {key[2]: metrics["ate.rmse"] for key, metrics in runs.items()}
        compared = {key[2]: errors_m[key[2]] for key, metrics in runs.items() if tracked_enough(metrics)}
        repeats = compare_repeats(errors_m, compared)
        found |= {key: judge({**metrics, **repeats.get(key[2], {})}) for key, metrics in runs.items()}
    return found


def test_all_122_published_runs_are_good(measured):
    """59 of them cover less than 75 % of the time by the fixed gap, by which they used to fail."""
    old = Counter(key[0] for key, metrics in measured.items() if metrics["tracked_fraction"] < 0.75)
    assert old == {"vislam_ba": 42, "vislam_rp": 17}
    found = verdicts(measured)
    assert Counter(key[0] for key in found) == SYSTEMS
    assert {key: verdict.words for key, verdict in found.items() if verdict.failed} == {}


def test_the_rule_is_not_at_its_limit_on_any_of_them(measured):
    assert min(metrics["tracked.path"] for metrics in measured.values()) > 0.72
    assert max(metrics["ate.per_path"] for metrics in measured.values()) < 1.0
    assert max(metrics["ate.per_extent"] for metrics in measured.values()) < 35.0


def test_runs_that_stop_after_60_percent_or_lose_the_middle_half_fail(truths, estimates):
    kinds: Counter[VerdictKind] = Counter()
    for (_, sequence, _), estimate in estimates.items():
        stamps_s, span = estimate.stamps_s, truths[sequence].trajectory.stamps_s[[0, -1]]
        share = (stamps_s - span[0]) / (span[1] - span[0])
        own = (stamps_s - stamps_s[0]) / (stamps_s[-1] - stamps_s[0])
        for kept in (share < 0.6, own < 0.6, (share < 0.25) | (share > 0.75)):
            kinds[judge(evidence(truths[sequence], part(estimate, kept))).kind] += 1
    assert kinds == {VerdictKind.TRACKED_TOO_LITTLE: 3 * len(estimates)}


def astray(runs, diverged):
    """The same runs, some of which have the error of a run that went 1.4 m astray."""
    changed = {key: dict(metrics) for key, metrics in runs.items()}
    for key in diverged:
        for name in ("ate.per_path", "ate.per_extent", "ate.rmse"):
            changed[key][name] *= 1.4 / runs[key]["ate.rmse"]
    return changed


def test_repeats_that_diverge_by_1_4_m_fail_and_the_others_stay_good(measured):
    """Of every configuration with five repeats: each of them in turn, and the two worst."""
    for place in {key[:2] for key in measured if key[0].startswith("vislam")}:
        runs = {key: metrics for key, metrics in measured.items() if key[:2] == place}
        by_error = sorted(runs, key=lambda key: runs[key]["ate.rmse"])
        for diverged in [*({key} for key in runs), set(by_error[-2:])]:
            found = verdicts(astray(runs, diverged))
            assert {key for key, verdict in found.items() if verdict.failed} == diverged


def test_other_published_trajectories():
    """RGBDSLAM on freiburg1_xyz is good; the ORB keyframes begin after 11 of its 30 s of motion."""
    truth = TruthReference(read_tum(EVO / "freiburg1_xyz-groundtruth.txt"))
    found = {
        name: judge(evidence(truth, read_tum(EVO / f"freiburg1_xyz-{name}.txt"), alignment)).kind
        for name, alignment in (("rgbdslam", Alignment.SE3), ("ORB_kf_mono", Alignment.SIM3))
    }
    assert found == {"rgbdslam": VerdictKind.GOOD, "ORB_kf_mono": VerdictKind.TRACKED_TOO_LITTLE}
