"""Made-up trajectories whose figures are known, paired by the real association and alignment."""

from pathlib import Path

import numpy as np

from slamhive.domain.protocol import Alignment, Protocol
from slamhive.evaluation.evaluators.base import Paired
from slamhive.evaluation.pairing import pair
from slamhive.evaluation.references import TruthReference
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import quats_from_rotations, rotations_from_quats

SE3 = Protocol(Alignment.SE3)


def rotation_z(angles_rad: np.ndarray) -> np.ndarray:
    """Quaternions about z."""
    zero = np.zeros_like(angles_rad)
    return np.column_stack([zero, zero, np.sin(angles_rad / 2), np.cos(angles_rad / 2)])


def loop(count: int = 400, duration_s: float = 40.0, size_m: float = 4.0) -> Trajectory:
    """A bent loop, looking ahead, climbing and sinking."""
    stamps_s = 100.0 + np.linspace(0.0, duration_s, count)
    angle = np.linspace(0.0, 2 * np.pi, count)
    positions_m = size_m * np.column_stack([np.cos(angle), 0.7 * np.sin(angle), 0.2 * np.sin(2 * angle)])
    return Trajectory(stamps_s, positions_m, rotation_z(angle + np.pi / 2))


def road(count: int = 2000, step_m: float = 0.6) -> Trajectory:
    """A winding road long enough for the KITTI protocol, a pose a step."""
    heading = 0.2 * np.sin(np.arange(count) / 150.0)
    steps_m = step_m * np.column_stack([np.cos(heading), np.sin(heading), 0.02 * np.cos(heading)])
    positions_m = np.vstack([np.zeros(3), np.cumsum(steps_m[:-1], axis=0)])
    return Trajectory(np.linspace(0.0, 0.1 * (count - 1), count), positions_m, rotation_z(heading))


def scaled(trajectory: Trajectory, factor: float) -> Trajectory:
    """Every length times ``factor``."""
    return Trajectory(trajectory.stamps_s, factor * trajectory.positions_m, trajectory.quats_xyzw)


def moved(trajectory: Trajectory) -> Trajectory:
    """The same motion in another world."""
    R = rotations_from_quats(np.array([[0.5, -0.5, 0.5, 0.5]]))[0]
    quats = quats_from_rotations(R @ rotations_from_quats(trajectory.quats_xyzw))
    return Trajectory(trajectory.stamps_s, trajectory.positions_m @ R.T + [5.0, -6.0, 7.0], quats)


def kept(trajectory: Trajectory, chosen: np.ndarray) -> Trajectory:
    """Only the chosen poses."""
    return Trajectory(trajectory.stamps_s[chosen], trajectory.positions_m[chosen], trajectory.quats_xyzw[chosen])


def noisy(trajectory: Trajectory, seed: int = 1) -> Trajectory:
    """With noise of 1 cm and about 1 degree."""
    rng = np.random.default_rng(seed)
    positions_m = trajectory.positions_m + 0.01 * rng.standard_normal(trajectory.positions_m.shape)
    quats = trajectory.quats_xyzw + 0.01 * rng.standard_normal(trajectory.quats_xyzw.shape)
    return Trajectory(trajectory.stamps_s, positions_m, quats / np.linalg.norm(quats, axis=1, keepdims=True))


def paired(
    reference: Trajectory,
    estimate: Trajectory,
    protocol: Protocol = SE3,
    *,
    files: dict[str, Path] | None = None,
    rotations_known: bool = True,
) -> Paired:
    """As an evaluation pairs them."""
    return pair(TruthReference(reference, rotations_known=rotations_known), estimate, protocol, files)
