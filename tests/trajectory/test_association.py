"""Which pose answers to which: the rules of evo and of TUM, ground truth between its poses, and estimates held."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from evo.core.sync import matching_time_indices

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment, Association, Protocol
from slamhive.trajectory.association import associate, match_in_one_sweep, match_nearest, match_one_to_one
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.pose_file import read_image_times
from slamhive.trajectory.transforms import interpolate

pytestmark = pytest.mark.quick

HALF = np.sqrt(0.5)


def straight(stamps_s: np.ndarray) -> Trajectory:
    """1 m/s along x, turning about z by 90 degrees in 2 s."""
    angle = stamps_s * np.pi / 4
    quats = np.column_stack([0 * angle, 0 * angle, np.sin(angle / 2), np.cos(angle / 2)])
    return Trajectory(stamps_s, np.column_stack([stamps_s, 0 * stamps_s, 0 * stamps_s]), quats)


def protocol(how: Association, **values: float) -> Protocol:
    return Protocol(Alignment.NONE, association=how, **values)  # type: ignore[arg-type]


@pytest.mark.parametrize(("many", "few"), [(400, 60), (60, 400), (100, 100)])
def test_nearest_is_evos_rule(many: int, few: int) -> None:
    random = np.random.default_rng(many)
    for _ in range(20):
        reference_s = np.unique(np.round(random.uniform(0, 5, many), 2))
        estimate_s = np.unique(np.round(random.uniform(-1, 6, few), 2))
        of_reference, of_estimate = match_nearest(reference_s, estimate_s, 0.03)
        if len(estimate_s) > len(reference_s):
            expected = matching_time_indices(reference_s, estimate_s, 0.03)
            assert (of_reference.tolist(), of_estimate.tolist()) == expected
        else:
            expected = matching_time_indices(estimate_s, reference_s, 0.03)
            assert (of_estimate.tolist(), of_reference.tolist()) == expected


def sweep(reference_s: list[float], estimate_s: list[float], tolerance_s: float) -> list[tuple[int, int]]:
    """The rule as OpenVINS steps through both lists, with one pointer that only moves on."""
    taken: list[tuple[int, int]] = []
    pointer = 0
    for j, stamp_s in enumerate(estimate_s):
        while pointer < len(reference_s) and reference_s[pointer] < stamp_s - tolerance_s:
            pointer += 1
        best_s, best = tolerance_s, None
        while pointer < len(reference_s) and (gap_s := abs(reference_s[pointer] - stamp_s)) < best_s:
            best_s, best = gap_s, pointer
            pointer += 1
        if best is not None:
            taken.append((best, j))
    return taken


@pytest.mark.parametrize(("many", "few"), [(200, 40), (40, 200), (100, 100)])
def test_one_sweep_is_the_rule_of_openvins(many: int, few: int) -> None:
    random = np.random.default_rng(many)
    for _ in range(20):
        reference_s = np.unique(np.round(random.uniform(0, 2, many), 3))
        estimate_s = np.unique(np.round(random.uniform(-0.5, 2.5, few), 3))
        found = match_in_one_sweep(reference_s, estimate_s, 0.0215)
        assert list(zip(*map(np.ndarray.tolist, found), strict=True)) == sweep(
            reference_s.tolist(), estimate_s.tolist(), 0.0215
        )


def test_a_sweep_gives_what_is_taken_to_nobody_else() -> None:
    of_reference, of_estimate = match_in_one_sweep(np.array([0.0, 1.0]), np.array([0.4, 0.9, 1.2]), 0.7)
    assert (of_reference.tolist(), of_estimate.tolist()) == ([0, 1], [0, 1])
    nobody, none = match_in_one_sweep(np.array([0.0]), np.array([5.0]), 0.1)
    assert len(nobody) == len(none) == 0


def test_an_estimate_is_held_where_the_ground_truth_is_dense() -> None:
    truth, estimate = straight(np.array([0.0, 0.01, 0.02, 0.5, 0.51, 0.52])), straight(np.array([0.0, 1.0]))
    every, _ = associate(truth, estimate, protocol(Association.HOLD))
    assert len(every) == 6
    dense, held = associate(truth, estimate, protocol(Association.HOLD, hold_interval_s=0.1))
    assert dense.stamps_s.tolist() == [0.0, 0.01, 0.5, 0.51], "the last of each stretch has no near one after it"
    assert held.positions_m[:, 0] == pytest.approx(dense.stamps_s)
    with pytest.raises(InvalidInput, match=r"no two poses of the ground truth are within 0\.001 s, the hold interval"):
        associate(truth, estimate, protocol(Association.HOLD, hold_interval_s=0.001))


def test_an_estimate_is_held_at_the_times_of_images_that_the_ground_truth_encloses() -> None:
    truth, estimate = straight(np.array([0.0, 0.01, 0.02, 0.5, 0.51])), straight(np.array([0.005, 0.4]))
    images_s = np.array([-1.0, 0.0, 0.004, 0.019, 0.3, 0.505, 0.51, 2.0])
    held = protocol(Association.HOLD, hold_interval_s=0.1)
    matched, found = associate(truth, estimate, held, images_s)
    assert matched.stamps_s.tolist() == [0.0, 0.004, 0.019, 0.505], "the last pose of the ground truth has no next one"
    assert matched.positions_m[:, 0] == pytest.approx([0.0, 0.004, 0.019, 0.505])
    assert found.positions_m[:, 0] == pytest.approx([0.005, 0.005, 0.019, 0.4])
    everywhere, _ = associate(truth, estimate, protocol(Association.HOLD), images_s)
    assert everywhere.stamps_s.tolist() == [0.0, 0.004, 0.019, 0.3, 0.505]
    with pytest.raises(InvalidInput, match=r"no image was taken between two poses .* at most 0\.1 s apart: 1 images"):
        associate(truth, estimate, held, np.array([0.3]))


@pytest.mark.parametrize(
    ("text", "expected_s"),
    [
        ("# timestamp filename\n10.5 rgb/10.5.png\n\n10.25 rgb/10.25.png\n", [10.25, 10.5]),
        ("#timestamp [ns],filename\n10250000000,a.png\n10500000000,b.png\n", [10.25, 10.5]),
        ("10.25\n10.5\n10.5\n", [10.25, 10.5]),
    ],
)
def test_times_of_images_are_read_from_lists(tmp_path: Path, text: str, expected_s: list[float]) -> None:
    (tmp_path / "rgb.txt").write_text(text)
    assert read_image_times(tmp_path / "rgb.txt", (10.0, 12.0)).tolist() == expected_s


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("10.25 a.png\nrgb/10.5.png\n", r"rgb\.txt, line 2: 'rgb/10\.5\.png' is not a timestamp"),
        ("nan a.png\n", r"rgb\.txt, line 1: 'nan' is not a timestamp"),
        ("# nothing\n", r"rgb\.txt names no image"),
        ("1500.25 a.png\n1500.5 b.png\n", r"the images are from 1500\.250 s to 1500\.500 s, .*the clocks do not meet"),
        ("0 a.png\n1 b.png\n", r"rgb\.txt: the time unit is in doubt: .*; write the timestamps in seconds"),
    ],
)
def test_a_list_of_images_without_usable_times_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "rgb.txt").write_text(text)
    with pytest.raises(InvalidInput, match=reason):
        read_image_times(tmp_path / "rgb.txt", (10.0, 12.0))


def greedy(reference_s: np.ndarray, estimate_s: np.ndarray, tolerance_s: float) -> list[tuple[int, int]]:
    """The rule as published: all pairs by growing gap, each stamp once."""
    pairs = itertools.product(range(len(reference_s)), range(len(estimate_s)))
    gaps = sorted((abs(reference_s[i] - estimate_s[j]), i, j) for i, j in pairs)
    taken: list[tuple[int, int]] = []
    for gap_s, i, j in gaps:
        if gap_s < tolerance_s and i not in {a for a, _ in taken} and j not in {b for _, b in taken}:
            taken.append((i, j))
    return sorted(taken, key=lambda pair: pair[1])


def test_one_to_one_is_tums_rule() -> None:
    random = np.random.default_rng(4)
    for _ in range(20):
        reference_s = np.unique(np.round(random.uniform(0, 1, 30), 3))
        estimate_s = np.unique(np.round(random.uniform(0, 1, 40), 3))
        of_reference, of_estimate = match_one_to_one(reference_s, estimate_s, 0.02)
        assert list(zip(of_reference.tolist(), of_estimate.tolist(), strict=True)) == greedy(
            reference_s, estimate_s, 0.02
        )
        assert len(set(of_reference)) == len(of_reference)


def test_ground_truth_is_interpolated_between_close_poses_only() -> None:
    reference = straight(np.array([0.0, 0.5, 1.0, 3.0, 3.5]))
    estimate = straight(np.array([-0.1, 0.0, 0.25, 0.9, 2.0, 3.0, 3.4, 3.6]))
    matched, kept = associate(reference, estimate, protocol(Association.INTERPOLATE, interpolation_interval_s=0.6))
    np.testing.assert_allclose(kept.stamps_s, [0.0, 0.25, 0.9, 3.0, 3.4])
    np.testing.assert_allclose(matched.positions_m, kept.positions_m, atol=1e-12)
    np.testing.assert_allclose(matched.quats_xyzw, kept.quats_xyzw, atol=1e-9)


def test_a_held_estimate_answers_to_every_stamp() -> None:
    reference, estimate = straight(np.linspace(0, 4, 9)), straight(np.array([1.0, 2.0]))
    matched, held = associate(reference, estimate, protocol(Association.HOLD))
    assert len(matched) == len(held) == 9
    np.testing.assert_allclose(held.positions_m[:, 0], [1, 1, 1, 1.5, 2, 2, 2, 2, 2])


def test_by_index_needs_as_many_poses() -> None:
    matched, found = associate(straight(np.arange(3.0)), straight(np.arange(3.0) + 50), protocol(Association.INDEX))
    assert len(matched) == len(found) == 3
    with pytest.raises(InvalidInput, match="the estimate has 2 and the ground truth 3"):
        associate(straight(np.arange(3.0)), straight(np.arange(2.0)), protocol(Association.INDEX))


@pytest.mark.parametrize("how", [how for how in Association if how is not Association.INDEX])
def test_no_overlap_in_time_is_named(how: Association) -> None:
    with pytest.raises(InvalidInput, match=r"do not overlap in time: estimate 100\.000 to 102\.000 s"):
        associate(straight(np.arange(3.0)), straight(np.arange(3.0) + 100), protocol(how))


def test_a_turn_takes_the_shorter_way() -> None:
    turned = Trajectory(np.array([0.0, 1.0]), np.zeros((2, 3)), np.array([[0, 0, 0, 1], [0, 0, -HALF, -HALF]]))
    (quat,) = interpolate(turned, np.array([0.5])).quats_xyzw
    np.testing.assert_allclose(np.abs(quat), [0, 0, np.sin(np.pi / 8), np.cos(np.pi / 8)], atol=1e-12)


def test_the_estimate_is_interpolated_at_a_sparse_truth_within_its_gaps() -> None:
    estimate = straight(np.concatenate([np.arange(0.0, 4.0, 0.1), np.arange(6.0, 10.0, 0.1)]))
    truth = straight(np.arange(-0.55, 12.0, 1.0))
    reference, matched = associate(truth, estimate, protocol(Association.INTERPOLATE_ESTIMATE))
    # Nothing before its start, in its gap of 2 s, or after its end.
    assert reference.stamps_s == pytest.approx([0.45, 1.45, 2.45, 3.45, 6.45, 7.45, 8.45, 9.45])
    assert matched.stamps_s == pytest.approx(reference.stamps_s)
    assert matched.positions_m == pytest.approx(reference.positions_m, abs=1e-12)
    bridged, _ = associate(truth, estimate, protocol(Association.INTERPOLATE_ESTIMATE, interpolation_interval_s=2.2))
    assert 5.45 in bridged.stamps_s.round(6)
    with pytest.raises(
        InvalidInput, match=r"interpolate_estimate and interpolation_interval_s: 0\.2, which matches 8 of"
    ):
        associate(truth, estimate, protocol(Association.NEAREST))
