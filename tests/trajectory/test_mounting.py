"""The transform between two frames of one body, fitted to matched poses."""

from __future__ import annotations

import numpy as np
import pytest

from slamhive.trajectory.alignment import fit_offset
from slamhive.trajectory.model import FloatArray, Poses
from slamhive.trajectory.transforms import rotations_from_quats

TIMES_S = np.arange(12.0)


def poses(positions_m: FloatArray, turned_rad: FloatArray) -> Poses:
    """Poses that turn about z."""
    zeros = np.zeros_like(turned_rad)
    quats_xyzw = np.column_stack([zeros, zeros, np.sin(turned_rad / 2), np.cos(turned_rad / 2)])
    return Poses(TIMES_S, positions_m, quats_xyzw)


@pytest.mark.parametrize("oriented", [True, False])
@pytest.mark.parametrize("turn_rad", [0.0, 1e-15, 1e-7, 1e-5])
def test_a_body_that_never_turns_leaves_the_lever_arm_open(oriented: bool, turn_rad: float) -> None:
    turned_rad = turn_rad * np.sin(TIMES_S)
    reference = poses(np.column_stack([TIMES_S, 0.025 * TIMES_S**2, 0.1 * (TIMES_S % 3)]), turned_rad)
    estimate = poses(np.column_stack([TIMES_S, TIMES_S**2, 0 * TIMES_S]), turned_rad)
    offset = fit_offset(reference, estimate, oriented=oriented, scaled=False)
    assert offset.arm_m == pytest.approx(np.zeros(3), abs=1e-9)
    assert np.isinf(offset.arm_sigma_m).all()
    assert offset.after_m == pytest.approx(offset.before_m)


def test_a_turn_about_one_axis_leaves_the_arm_along_it_open() -> None:
    arm_m = np.array([0.3, -0.2, 0.0])
    turned_rad = 0.4 * TIMES_S
    estimate = poses(np.column_stack([TIMES_S, np.sin(TIMES_S), 0.1 * np.cos(2 * TIMES_S)]), turned_rad)
    moved_m = estimate.positions_m - rotations_from_quats(estimate.quats_xyzw) @ arm_m
    offset = fit_offset(poses(moved_m, turned_rad), estimate, oriented=True, scaled=False)
    assert offset.arm_m == pytest.approx(arm_m, abs=1e-9)
    assert np.isinf(offset.arm_sigma_m).tolist() == [False, False, True]


def test_estimates_that_went_astray_are_fitted_without_overflow() -> None:
    generator = np.random.default_rng(0)
    for exponent in range(-8, 1):
        for far in (1.0, 1e3, 1e6, 1e12):
            turned_rad = 10.0**exponent * generator.standard_normal(len(TIMES_S))
            reference = poses(generator.standard_normal((12, 3)), turned_rad)
            estimate = poses(far * generator.standard_normal((12, 3)).cumsum(axis=0), turned_rad[::-1])
            for oriented in (True, False):
                offset = fit_offset(reference, estimate, oriented=oriented, scaled=False)
                assert np.isfinite([offset.after_m, *offset.arm_m]).all()
                assert offset.after_m <= offset.before_m * 1.000001, (exponent, far, oriented)
