from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.trajectory.alignment import align_umeyama, align_yaw_position
from slamhive.trajectory.completeness import measure_completeness
from slamhive.trajectory.kitti import read_kitti, write_kitti
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import (
    move_sensor,
    quats_from_rotations,
    rigid_transform,
    rotations_from_quats,
)


def random_quats(count: int) -> np.ndarray:
    quats = np.random.default_rng(3).normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return quats


def test_quaternions_and_rotations_are_inverse_on_every_branch() -> None:
    quats = np.vstack([random_quats(200), np.eye(4)])
    rotations = rotations_from_quats(quats)
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.stack([np.eye(3)] * 204), atol=1e-14)
    np.testing.assert_allclose(np.abs((quats_from_rotations(rotations) * quats).sum(axis=1)), 1.0, atol=1e-12)


def test_the_ground_truth_moves_into_the_sensor_frame() -> None:
    half = np.sqrt(0.5)
    body = Trajectory(np.array([0.0, 1.0]), np.zeros((2, 3)), np.array([[0, 0, 0, 1], [0, 0, half, half]]))
    T_body_sensor = np.eye(4)
    T_body_sensor[0, 3] = 2.0
    sensor = move_sensor(body, T_body_sensor)
    np.testing.assert_allclose(sensor.positions_m, [[2, 0, 0], [0, 2, 0]], atol=1e-15)


@pytest.mark.parametrize("numbers", [[1.0] * 16, [0.0] * 15, [float("nan")] * 16, [*np.diag([1.0, 1, -1, 1]).ravel()]])
def test_what_is_not_a_rigid_transform_is_refused(numbers: list[float]) -> None:
    with pytest.raises(InvalidInput, match="T_body_sensor"):
        rigid_transform(numbers, "T_body_sensor")


def test_yaw_and_position_are_found_again() -> None:
    p = np.random.default_rng(5).normal(size=(30, 3))
    yaw = 2.2
    R = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    q = p @ R.T + [1, -2, 3]
    T = align_yaw_position(p, q)
    np.testing.assert_allclose(T.rotation, R, atol=1e-12)
    np.testing.assert_allclose(T.translation_m, [1, -2, 3], atol=1e-12)


def test_what_yaw_cannot_be_found_from() -> None:
    vertical = np.column_stack([np.zeros(5), np.zeros(5), np.arange(5.0)])
    for positions in (vertical, np.ones((5, 3))):
        with pytest.raises(InvalidInput, match="yaw cannot be determined"):
            align_yaw_position(positions, positions)


def test_the_rank_problem_of_a_line_is_named() -> None:
    line = np.outer(np.arange(20.0), [1.0, 0.3, -0.2])
    with pytest.raises(InvalidInput, match=r"straight line \(rank below 2\)"):
        align_umeyama(line, line, scaled=False)
    with pytest.raises(InvalidInput, match="the estimate stands still"):
        align_umeyama(np.zeros((20, 3)), line, scaled=False)
    noise_m = np.random.default_rng(1).normal(scale=1e-3, size=line.shape)
    align_umeyama(line + noise_m, line + np.sin(line) * [[0, 0, 1]], scaled=True)


@pytest.mark.parametrize(
    ("stamps", "fraction", "longest", "count"),
    [
        (np.linspace(0, 100, 1001), 1.0, 0.1, 0),
        (np.linspace(-50, 150, 2001), 1.0, 0.1, 0),
        (np.concatenate([np.linspace(0, 25, 251), np.linspace(75, 100, 251)]), 0.5, 50.0, 1),
        (np.linspace(10, 60, 501), 0.5, 40.0, 2),
        (np.linspace(200, 300, 11), 0.0, 100.0, 1),
        (np.array([50.0]), 0.0, 50.0, 2),
    ],
)
def test_completeness(stamps: np.ndarray, fraction: float, longest: float, count: int) -> None:
    found = measure_completeness(stamps, np.linspace(0, 100, 501), 1.0)
    assert found.tracked_fraction == pytest.approx(fraction, abs=1e-9)
    assert found.longest_gap_s == pytest.approx(longest)
    assert found.gap_count == count


def test_completeness_needs_a_span() -> None:
    with pytest.raises(InvalidInput, match="one pose"):
        measure_completeness(np.array([0.0, 1.0]), np.array([0.0]), 1.0)


def test_kitti_round_trip_and_mistakes(tmp_path: Path) -> None:
    poses, times = tmp_path / "poses.txt", tmp_path / "times.txt"
    trajectory = Trajectory(np.arange(4.0), np.random.default_rng(2).normal(size=(4, 3)), random_quats(4))
    write_kitti(poses, trajectory)
    times.write_text("0\n1\n2\n3\n")
    again = read_kitti(poses, times)
    np.testing.assert_allclose(again.positions_m, trajectory.positions_m, atol=1e-11)
    times.write_text("0\n1\n2\n")
    with pytest.raises(InvalidInput, match=r"4 poses.*3 timestamps"):
        read_kitti(poses, times)
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 1 0 0 0 0 1 0\n")
    times.write_text("0\n1\n")
    with pytest.raises(InvalidInput, match=r"line 2: the 3x3 part is not a rotation"):
        read_kitti(poses, times)


def test_a_trajectory_is_read_only_and_checked() -> None:
    trajectory = Trajectory(np.arange(2.0), np.eye(3)[:2], random_quats(2))
    assert trajectory.span_s == 1.0
    assert trajectory.path_length_m == pytest.approx(np.sqrt(2))
    with pytest.raises(ValueError, match="read-only"):
        trajectory.positions_m[0] = 0
    with pytest.raises(InvalidInput, match="pose 1: timestamp"):
        Trajectory(np.array([1.0, 0.0]), np.zeros((2, 3)), random_quats(2))
    with pytest.raises(InvalidInput, match="at least one pose"):
        Trajectory(np.empty(0), np.empty((0, 3)), np.empty((0, 4)))
    with pytest.raises(InvalidInput, match="shape"):
        Trajectory(np.arange(2.0), np.zeros((3, 3)), random_quats(2))
