"""Angular rates of an IMU and of the ground truth over the same cells of time, and how they differ.

Rates are means over short cells, so that noise of the ground truth matters little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamhive.checks.evidence import Array, Stream
from slamhive.checks.geometry import matrix
from slamhive.checks.truth_file import median_step_s, usable_gap_s
from slamhive.trajectory.interpolation import interpolate
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import inverse_quats, multiply_quats

CELL_S = 0.05
"""Angular rates change little in this time; noise of orientations (0.2 deg) makes 0.1 rad/s of it."""
FINE_STEP_S = 0.002
MOST_CELLS, MOST_GAPS = 20_000, 1000
FEWEST_CELLS = 20
LEAST_TURNING_RADPS = 0.05
"""Root mean square; with less rotation nothing can be compared."""
WITHIN_S = 2.0
"""Offsets that are searched; larger ones leave little of most recordings in common."""
LEAST_CORRELATION = 0.7


@dataclass(frozen=True, eq=False)
class RatePair:
    """Angular rates of IMU and ground truth, in the body frame, to be compared at any time offset.

    ``edges_s`` (n + 1,) bound cells of equal length, ``true`` (n, 3) are mean rates of the ground truth in them, and
    ``kept`` (n,) marks those that are free of gaps. ``turned`` (m, 3) is the integral of the IMU's rates up to
    ``times_s`` (m,).
    """

    edges_s: Array
    true: Array
    kept: Array
    times_s: Array
    turned: Array

    def at(self, offset_s: float) -> tuple[Array, Array]:
        """Mean rates of IMU and ground truth over the same cells, (k, 3), ``offset_s`` added to the IMU's times."""
        at_s = self.edges_s - offset_s
        turned = np.column_stack([np.interp(at_s, self.times_s, self.turned[:, axis]) for axis in range(3)])
        inside = self.kept & (at_s[:-1] >= self.times_s[0]) & (at_s[1:] <= self.times_s[-1])
        return (np.diff(turned, axis=0) / (self.edges_s[1] - self.edges_s[0]))[inside], self.true[inside]

    def correlation(self, offset_s: float) -> float:
        """Correlation of the magnitudes; NaN if too few cells are left."""
        first, second = (np.linalg.norm(rates, axis=1) for rates in self.at(offset_s))
        if len(first) < FEWEST_CELLS:
            return np.nan
        first, second = first - first.mean(), second - second.mean()
        norm = float(np.linalg.norm(first) * np.linalg.norm(second))
        return float(first @ second) / norm if norm > 0 else np.nan

    def offset_s(self) -> float | None:
        """What to add to the IMU's times so that the magnitudes fit best; None where they never resemble each other."""
        coarse = np.arange(-WITHIN_S, WITHIN_S + CELL_S / 2, CELL_S)
        scores = np.array([self.correlation(float(offset)) for offset in coarse])
        if not np.isfinite(scores).any() or np.nanmax(scores) < LEAST_CORRELATION:
            return None
        fine = coarse[int(np.nanargmax(scores))] + np.arange(-CELL_S, CELL_S + 1e-9, FINE_STEP_S)
        return _peak(fine, np.array([self.correlation(float(offset)) for offset in fine]))


def pair_rates(stream: Stream, poses: Trajectory) -> RatePair | str:
    """The angular rates of an IMU and of the ground truth, or why they cannot be compared."""
    assert stream.imu is not None
    times_s, turned = _integral(stream.header_ns[: len(stream.imu)] * 1e-9, stream.imu[:, :3].astype(np.float64))
    if len(times_s) < FEWEST_CELLS:
        return "the IMU has too few valid samples"
    cell_s = max(CELL_S, median_step_s(poses), 2.0 / stream.sensor.rate_hz)
    begin_s, end_s = max(times_s[0], poses.stamps_s[0]), min(times_s[-1], poses.stamps_s[-1])
    count = int(min(MOST_CELLS, (end_s - begin_s) / cell_s))
    if count < FEWEST_CELLS:
        return "ground truth and IMU share too little time"
    edges_s = begin_s + cell_s * np.arange(count + 1)
    true = rotation_vectors(interpolate(poses, edges_s).quats_xyzw) / cell_s
    kept = ~_in_gaps(poses, edges_s)
    if kept.sum() < FEWEST_CELLS:
        return "the ground truth has too many gaps"
    if rms(true[kept] - true[kept].mean(axis=0)) < LEAST_TURNING_RADPS:
        return "the body hardly turns"
    R_body_imu = matrix(stream.sensor.T_body_sensor)[:3, :3]
    return RatePair(edges_s, true, kept, times_s, turned @ R_body_imu.T)


def _in_gaps(poses: Trajectory, edges_s: Array) -> Array:
    """Which cells lie in a gap of the ground truth, (n,) bool."""
    wide = np.flatnonzero(np.diff(poses.stamps_s) > usable_gap_s(poses))
    bad = np.zeros(len(edges_s) - 1, dtype=bool)
    for index in wide[:MOST_GAPS]:
        bad |= (edges_s[1:] > poses.stamps_s[index]) & (edges_s[:-1] < poses.stamps_s[index + 1])
    return bad


def rotation_vectors(quats_xyzw: Array) -> Array:
    """Rotation from each orientation to the next, as angle times axis in the frame of the first, (n - 1, 3)."""
    between = multiply_quats(inverse_quats(quats_xyzw[:-1]), quats_xyzw[1:])
    between *= np.where(between[:, 3:] < 0, -1.0, 1.0)
    sines = np.linalg.norm(between[:, :3], axis=1, keepdims=True)
    angles = 2.0 * np.arctan2(sines, between[:, 3:])
    return np.asarray(np.where(sines > 1e-12, between[:, :3] / np.maximum(sines, 1e-12) * angles, 0.0))


def _integral(times_s: Array, rates: Array) -> tuple[Array, Array]:
    """Increasing times (m,) and the integral of ``rates`` up to each, (m, 3), by the trapezoidal rule."""
    finite = np.isfinite(rates).all(axis=1)
    times_s, chosen = np.unique(times_s[finite], return_index=True)
    rates = rates[finite][chosen]
    areas = 0.5 * (rates[1:] + rates[:-1]) * np.diff(times_s)[:, None]
    return times_s, np.vstack((np.zeros(3), np.cumsum(areas, axis=0)))


def _peak(offsets_s: Array, scores: Array) -> float:
    """The highest point of the parabola through the best score and its neighbours."""
    best = int(np.nanargmax(scores))
    if best in {0, len(scores) - 1}:
        return float(offsets_s[best])
    before, at, after = scores[best - 1 : best + 2]
    curve = before - 2 * at + after
    shift = 0.5 * (before - after) / curve if curve < 0 else 0.0
    return float(offsets_s[best] + shift * (offsets_s[1] - offsets_s[0]))


def misfit_of(first: Array, second: Array) -> float:
    """Relative difference of rates (n, 3), a constant bias left out."""
    difference = (first - first.mean(axis=0)) - (second - second.mean(axis=0))
    return rms(difference) / rms(second - second.mean(axis=0))


def best_turn(measured: Array, true: Array, most: float) -> Array | None:
    """The rotation, or else the mirroring, that leaves a misfit of at most ``most`` (Kabsch 1976), (3, 3)."""
    U, _, Vt = np.linalg.svd((true - true.mean(axis=0)).T @ (measured - measured.mean(axis=0)))
    sign = np.sign(np.linalg.det(U @ Vt))
    for last in (sign, -sign):
        turn = U @ np.diag([1.0, 1.0, last]) @ Vt
        if misfit_of(measured @ turn.T, true) <= most:
            return np.asarray(turn)
    return None


def rms(rows: Array) -> float:
    """Root mean square of the lengths of rows (n, 3)."""
    return float(np.sqrt((rows**2).sum(axis=1).mean()))
