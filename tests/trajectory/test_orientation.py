"""Orientations that are none: zeros, and what never changes on a path that turns."""

import numpy as np
import pytest

from slamhive.trajectory.layout import POSITIONS_ONLY, parse_ground_truth, parse_rows
from slamhive.trajectory.model import NEVER_TURNS, ZERO, heading_change_rad, is_constant, lacking

ANGLES = np.linspace(0, np.pi, 40)
WINDING = np.column_stack((np.cos(ANGLES), np.sin(ANGLES), 0 * ANGLES)) * 5
STRAIGHT = np.column_stack((ANGLES, ANGLES, 0 * ANGLES))


def rows(quat, positions_m=WINDING):
    lines = [f"{number} {x} {y} {z} {quat}" for number, (x, y, z) in enumerate(positions_m)]
    return "\n".join(lines).encode()


def tiled(*quat):
    return np.tile(quat, (40, 1)).astype(float)


@pytest.mark.parametrize(
    ("quats", "positions_m", "found"),
    [
        (tiled(0, 0, 0, 0), STRAIGHT, ZERO),
        (tiled(0, 0, 0, 1), WINDING, NEVER_TURNS),
        (tiled(0.6, 0, 0, 0.8), WINDING, NEVER_TURNS),
        (tiled(0.6, 0, 0, 0.8) * np.where(np.arange(40) % 2, 1, -1)[:, None], WINDING, NEVER_TURNS),
        (tiled(0, 0, 0, 1), STRAIGHT, ""),
        (np.column_stack((0 * ANGLES, 0 * ANGLES, np.sin(ANGLES / 2), np.cos(ANGLES / 2))), WINDING, ""),
        (tiled(0, 0, 0, 1) + 1e-4 * np.eye(40, 4), WINDING, ""),
    ],
)
def test_orientations_that_mean_nothing_are_known(quats, positions_m, found):
    assert lacking(quats, positions_m) == found


def test_rest_has_no_heading():
    noise_m = np.random.default_rng(1).normal(0, 0.001, (40, 3))
    assert not is_constant(tiled(0, 0, 0, 1), noise_m)


@pytest.mark.parametrize(
    ("data", "without"),
    [
        (rows("0 0 0 0"), ZERO),
        (rows("0 0 0 1"), NEVER_TURNS),
        (rows("0 0 0 1", STRAIGHT), ""),
        (rows(""), POSITIONS_ONLY),
    ],
)
def test_a_ground_truth_says_why_its_orientations_mean_nothing(data, without):
    trajectory, found = parse_ground_truth(data, "truth")
    assert (len(trajectory), found) == (40, without)


def test_rows_without_orientation_have_no_quaternion_order():
    raw = parse_rows(rows("0 0 0 0"), "t.txt")
    assert (raw.orientations, raw.without, raw.quats[0].tolist()) == (False, ZERO, [0, 0, 0, 1])
    assert parse_rows(rows("0 0 0 1", STRAIGHT), "t.txt").orientations


def test_numbers_beyond_all_scales_are_no_path():
    """A damaged file may hold any number; the steps to and from it have no direction."""
    positions_m = np.zeros((20, 3))
    positions_m[:, 0] = np.arange(20)
    positions_m[9] = (9.0, 1e308, -1e308)
    assert heading_change_rad(positions_m) == 0.0
    quats = np.tile((0.0, 0.0, 0.0, 1.0), (20, 1))
    quats[3] = 1.7e308
    assert lacking(quats, positions_m) == ""
