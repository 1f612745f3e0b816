"""The IMU by itself: gravity and units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamhive.domain.dataset import Finding, NotChecked, Severity
from slamhive.domain.sensors import SensorKind
from slamhive.recordings.checks.evidence import TRUTH, Array, DatasetEvidence, Findings, StreamEvidence
from slamhive.recordings.checks.geometry import matrix
from slamhive.recordings.checks.timestamps import jumps
from slamhive.recordings.checks.truth import median_step_s, usable_gap_s, usable_poses, with_quats
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import interpolate, inverse_quats, multiply_quats, rotations_from_quats

GRAVITY_MPS2 = 9.81
GRAVITY_SHARE = 0.08
"""Gravity varies by 0.5 % on Earth, accelerometers are off by up to 5 %, and motion raises the median a little."""
IN_G = (0.9, 1.1)
"""An accelerometer at rest that reports g reads 1."""
NO_GRAVITY_MPS2 = 3.0
"""Without gravity what is left is the acceleration of the body."""
FASTEST_RADPS = 8.0
"""Median of a whole recording: no body turns so fast all the time, but 0.15 rad/s in deg/s is that."""
FEWEST_SAMPLES = 50


def gravity(evidence: DatasetEvidence) -> Findings:
    """The accelerometer measures gravity in m/s²."""
    for stream in _imus(evidence):
        samples = _samples(stream)
        if isinstance(samples, str):
            yield NotChecked("gravity", stream.sensor.name, samples)
            continue
        measured = float(np.median(np.linalg.norm(samples[:, 3:], axis=1)))
        if abs(measured / GRAVITY_MPS2 - 1.0) <= GRAVITY_SHARE:
            continue
        if IN_G[0] <= measured <= IN_G[1]:
            meaning, remedy = "it looks like g", "multiply the accelerations by 9.80665 when the recording is converted"
        elif measured < NO_GRAVITY_MPS2:
            meaning = "gravity seems to be removed"
            remedy = "record the raw accelerometer; algorithms need gravity in it"
        else:
            meaning, remedy = "the unit or the scale is wrong", "find out the unit, and convert to m/s²"
        yield stream.finding(
            "gravity",
            Severity.ERROR,
            f"{stream.sensor.name} measures {measured:.4g} m/s² as gravity: {meaning}.",
            remedy,
            value=measured,
            unit="m/s²",
            expected=f"{GRAVITY_MPS2} m/s² within {GRAVITY_SHARE:.0%}",
        )


def angular_rates(evidence: DatasetEvidence) -> Findings:
    """The gyroscope reports rad/s; only what no body does is found here, the rest by the ground truth."""
    for stream in _imus(evidence):
        rows = np.zeros((0, 6)) if stream.imu is None else stream.imu
        invalid = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(invalid):
            yield stream.finding(
                "imu-rates",
                Severity.ERROR,
                f"{len(invalid)} samples of {stream.sensor.name} hold a value that is not a number.",
                "leave out these samples when the recording is converted",
                **evidence.where(stream, invalid),
                value=float(len(invalid)),
                unit="samples",
                expected="numbers",
            )
            continue
        samples = _samples(stream)
        if isinstance(samples, str):
            yield NotChecked("imu-rates", stream.sensor.name, samples)
            continue
        rates = np.linalg.norm(samples[:, :3], axis=1)
        if not rates.any():
            yield stream.finding(
                "imu-rates",
                Severity.ERROR,
                f"All angular rates of {stream.sensor.name} are 0.",
                "record the gyroscope, or remove the sensor from dataset.yaml",
                value=0.0,
                unit="rad/s",
                expected="noise at least",
            )
        elif float(np.median(rates)) > FASTEST_RADPS:
            yield stream.finding(
                "imu-rates",
                Severity.ERROR,
                f"{stream.sensor.name} turns at {np.median(rates):.3g} rad/s all the time: it looks like deg/s.",
                "multiply the angular rates by pi / 180 when the recording is converted",
                value=float(np.median(rates)),
                unit="rad/s",
                expected=f"a median below {FASTEST_RADPS:g} rad/s",
            )


def _imus(evidence: DatasetEvidence) -> list[StreamEvidence]:
    return [stream for stream in evidence.of_kind(SensorKind.IMU) if stream.imu is not None]


def _samples(stream: StreamEvidence) -> Array | str:
    """The finite samples, or why they say nothing."""
    rows = np.zeros((0, 6)) if stream.imu is None else stream.imu
    finite: Array = rows[np.isfinite(rows).all(axis=1)]
    return finite if len(finite) >= FEWEST_SAMPLES else f"{len(finite)} samples are too few"


# Angular rates of an IMU and of the ground truth over the same cells of time, and how they differ.
#
# Rates are means over short cells, so that noise of the ground truth matters little.


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
        """Offset of the IMU's times at which the magnitudes fit best; None where they never resemble each other."""
        coarse = np.arange(-WITHIN_S, WITHIN_S + CELL_S / 2, CELL_S)
        scores = np.array([self.correlation(float(offset)) for offset in coarse])
        if not np.isfinite(scores).any() or np.nanmax(scores) < LEAST_CORRELATION:
            return None
        fine = coarse[int(np.nanargmax(scores))] + np.arange(-CELL_S, CELL_S + 1e-9, FINE_STEP_S)
        return _peak(fine, np.array([self.correlation(float(offset)) for offset in fine]))


def pair_rates(stream: StreamEvidence, poses: Trajectory) -> RatePair | str:
    """The angular rates of an IMU and of the ground truth, or why they cannot be compared."""
    assert stream.imu is not None
    # The integral of the rates up to each of increasing times, (m, 3), by the trapezoidal rule.
    times_s = stream.header_ns[: len(stream.imu)] * 1e-9
    rates = stream.imu[:, :3].astype(np.float64)
    finite = np.isfinite(rates).all(axis=1)
    times_s, chosen = np.unique(times_s[finite], return_index=True)
    rates = rates[finite][chosen]
    areas = 0.5 * (rates[1:] + rates[:-1]) * np.diff(times_s)[:, None]
    turned = np.vstack((np.zeros(3), np.cumsum(areas, axis=0)))
    if len(times_s) < FEWEST_CELLS:
        return "the IMU has too few valid samples"
    cell_s = max(CELL_S, median_step_s(poses), 2.0 / stream.sensor.rate_hz)
    begin_s, end_s = max(times_s[0], poses.stamps_s[0]), min(times_s[-1], poses.stamps_s[-1])
    count = int(min(MOST_CELLS, (end_s - begin_s) / cell_s))
    if count < FEWEST_CELLS:
        return "ground truth and IMU share too little time"
    edges_s = begin_s + cell_s * np.arange(count + 1)
    true = rotation_vectors(interpolate(poses, edges_s).quats_xyzw) / cell_s
    # A cell that touches a gap would compare the IMU with interpolated poses.
    wide = np.flatnonzero(np.diff(poses.stamps_s) > usable_gap_s(poses))
    kept = np.ones(len(edges_s) - 1, dtype=bool)
    for index in wide[:MOST_GAPS]:
        kept &= (edges_s[1:] <= poses.stamps_s[index]) | (edges_s[:-1] >= poses.stamps_s[index + 1])
    if kept.sum() < FEWEST_CELLS:
        return "the ground truth has too many gaps"
    if rms(true[kept] - true[kept].mean(axis=0)) < LEAST_TURNING_RADPS:
        return "the body hardly turns"
    R_body_imu = matrix(stream.sensor.T_body_sensor)[:3, :3]
    return RatePair(edges_s, true, kept, times_s, turned @ R_body_imu.T)


def rotation_vectors(quats_xyzw: Array) -> Array:
    """Rotation from each orientation to the next, as angle times axis in the frame of the first, (n - 1, 3)."""
    between = multiply_quats(inverse_quats(quats_xyzw[:-1]), quats_xyzw[1:])
    between *= np.where(between[:, 3:] < 0, -1.0, 1.0)
    sines = np.linalg.norm(between[:, :3], axis=1, keepdims=True)
    angles = 2.0 * np.arctan2(sines, between[:, 3:])
    return np.asarray(np.where(sines > 1e-12, between[:, :3] / np.maximum(sines, 1e-12) * angles, 0.0))


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


# The IMU against the ground truth: clocks, units, axes and the direction of gravity.
#
# The magnitude of the angular rate depends neither on frames nor on the order of quaternions, and shows time offset
# and unit. Once these are right, the vectors show axes, order and direction of the orientations.


CHECKS = ("imu-time-offset", "imu-units", "imu-axes", "truth-orientation", "gravity-direction")

OFFSET_S, LARGE_OFFSET_S = 0.01, 0.05
"""Visual-inertial systems suffer from 10 ms; above 50 ms few of them start at all."""
UNIT_RANGE = (0.75, 1.35)
"""A gyroscope's scale is right to 1 %, but noise adds to the magnitude."""
DEG = 57.29578
DEG_RANGE = 1.3
SUSPICIOUS, COLLAPSE, HOPELESS = 0.1, 0.5, 0.6
"""Relative difference of angular rates. From the first on, a mistake is reported that explains at least half of it;
beyond the last, the two do not belong together. Noise of the ground truth alone cannot be explained by a rotation."""
TILT_DEG = 12.0
"""Angle between mean specific force and the z axis of the world: biases and alignment make some degrees."""
STEADY = 0.9
"""Length of the mean specific force in the world over the mean length: 1 if its direction is kept."""


def imu_and_truth(evidence: DatasetEvidence) -> Findings:
    """Compare each IMU with the ground truth."""
    for stream in evidence.of_kind(SensorKind.IMU):
        poses: Trajectory | str
        if stream.imu is None or not stream.header_ns.any():
            poses = "the IMU cannot be read"
        elif jumps(stream).any():
            poses = "the clock of the IMU jumps"
        else:
            poses = usable_poses(evidence)
        if isinstance(poses, str):
            for check in CHECKS:
                yield NotChecked(check, stream.sensor.name, poses)
            continue
        yield from _compare(evidence, stream, poses)


def _compare(evidence: DatasetEvidence, stream: StreamEvidence, poses: Trajectory) -> Findings:
    name = stream.sensor.name
    pair = pair_rates(stream, poses)
    if isinstance(pair, str):
        for check in CHECKS:
            yield NotChecked(check, name, pair)
        return
    offset_s = pair.offset_s()
    if offset_s is None:
        yield NotChecked("imu-time-offset", name, "its angular rates do not resemble those of the ground truth")
    elif abs(offset_s) > OFFSET_S:
        direction = "ahead of" if offset_s < 0 else "behind"
        yield stream.finding(
            "imu-time-offset",
            Severity.ERROR if abs(offset_s) > LARGE_OFFSET_S else Severity.WARNING,
            f"The clock of {name} is {abs(offset_s) * 1e3:.0f} ms {direction} that of the ground truth.",
            f"add {offset_s:+.4f} s to the timestamps of the IMU, or subtract it from those of the ground truth",
            value=offset_s,
            unit="s",
            expected=f"within {OFFSET_S} s",
        )
    measured, true = pair.at(offset_s or 0.0)
    ratio = rms(measured - measured.mean(axis=0)) / rms(true - true.mean(axis=0))
    units = _units(stream, ratio) if offset_s is not None else None
    if units is not None:
        yield units
        yield NotChecked("imu-axes", name, "the unit of the angular rates is wrong")
        yield NotChecked("truth-orientation", name, "the unit of the angular rates is wrong")
        return
    wrong = list(_axes(stream, poses, pair, offset_s or 0.0))
    yield from wrong
    if wrong:
        yield NotChecked("gravity-direction", name, "the orientations contradict the IMU")
    else:
        yield from _gravity_direction(evidence, stream, poses, offset_s or 0.0)


def _units(stream: StreamEvidence, ratio: float) -> Finding | None:
    if UNIT_RANGE[0] <= ratio <= UNIT_RANGE[1]:
        return None
    if 1 / DEG_RANGE <= ratio / DEG <= DEG_RANGE:
        meaning, remedy = (
            ": they are in deg/s",
            "multiply the angular rates by pi / 180 when the recording is converted",
        )
    else:
        meaning, remedy = "", "find out unit and scale of the gyroscope"
    return stream.finding(
        "imu-units",
        Severity.ERROR,
        f"Angular rates of {stream.sensor.name} are {ratio:.3g} times those of the ground truth{meaning}.",
        remedy,
        value=ratio,
        unit="times",
        expected=f"{UNIT_RANGE[0]} to {UNIT_RANGE[1]}",
    )


def _axes(stream: StreamEvidence, poses: Trajectory, pair: RatePair, offset_s: float) -> Findings:
    """The mistake that explains a difference of the angular rates, if there is a difference."""
    measured, true = pair.at(offset_s)
    misfit = misfit_of(measured, true)
    if misfit <= SUSPICIOUS:
        return
    most = COLLAPSE * misfit
    reread = _reread(stream, poses, offset_s, most)
    if reread is not None:
        message, remedy = reread
        yield Finding(
            "truth-orientation",
            Severity.ERROR,
            TRUTH,
            message,
            remedy,
            value=misfit,
            unit="relative difference of angular rates",
            expected=f"below {SUSPICIOUS}",
        )
        return
    turn = best_turn(measured, true, most)
    if turn is None and misfit <= HOPELESS:
        return
    how, remedy = "in no fixed relation to", "check that IMU and ground truth belong together"
    degrees = None
    if turn is not None and np.linalg.det(turn) < 0:
        how, remedy = "mirrored (left-handed) against", "swap or negate axes as the data sheet says"
    elif turn is not None:
        degrees = float(np.rad2deg(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0))))
        how, remedy = f"turned by {degrees:.0f} deg against", "correct T_body_sensor in dataset.yaml"
    yield stream.finding(
        "imu-axes",
        Severity.ERROR,
        f"The axes of {stream.sensor.name} are {how} the body of the ground truth.",
        remedy,
        value=degrees,
        unit="deg",
        expected="the axes that T_body_sensor says",
    )


def _reread(stream: StreamEvidence, poses: Trajectory, offset_s: float, most: float) -> tuple[str, str] | None:
    """Name the fault of the quaternions, if reading them otherwise leaves a misfit of at most ``most``."""
    for quats, message, remedy in (
        (
            np.roll(poses.quats_xyzw, -1, axis=1),
            "The quaternions of the ground truth are in the order w x y z.",
            "write qx qy qz qw in its file",
        ),
        (
            inverse_quats(poses.quats_xyzw),
            "The orientations of the ground truth are those of the world in the body.",
            "invert them in its file",
        ),
    ):
        pair = pair_rates(stream, with_quats(poses, quats))
        if not isinstance(pair, str) and misfit_of(*pair.at(offset_s)) <= most:
            return message, remedy
    return None


def _gravity_direction(
    evidence: DatasetEvidence, stream: StreamEvidence, poses: Trajectory, offset_s: float
) -> Findings:
    """The specific force points up in a world whose z axis does, and keeps its direction in any."""
    times_s = stream.header_ns[: len(stream.imu if stream.imu is not None else ())] * 1e-9 + offset_s
    chosen = np.flatnonzero((times_s >= poses.stamps_s[0]) & (times_s <= poses.stamps_s[-1]))
    chosen = chosen[:: max(1, len(chosen) // MOST_CELLS)]
    if stream.imu is None or len(chosen) < FEWEST_CELLS:
        yield NotChecked("gravity-direction", stream.sensor.name, "ground truth and IMU share too little time")
        return
    forces = stream.imu[chosen, 3:].astype(np.float64) @ matrix(stream.sensor.T_body_sensor)[:3, :3].T
    R_world_body = rotations_from_quats(interpolate(poses, times_s[chosen]).quats_xyzw)
    mean = np.einsum("nij,nj->ni", R_world_body, forces).mean(axis=0)
    length, usual = float(np.linalg.norm(mean)), float(np.linalg.norm(forces, axis=1).mean())
    if usual < 1e-3:
        return
    tilt_deg = float(np.rad2deg(np.arccos(np.clip(mean[2] / max(length, 1e-9), -1.0, 1.0))))
    truth = evidence.dataset.groundtruth
    if length < STEADY * usual:
        what = f"The direction of gravity in the world changes during the recording ({length / usual:.0%} remain)."
        remedy = "check the axes of the accelerometer: gyroscope and ground truth agree"
    elif truth is not None and truth.gravity_aligned and tilt_deg > TILT_DEG:
        what = (
            f"The specific force is {tilt_deg:.0f} deg from the z axis of the world, which dataset.yaml says points up."
        )
        remedy = (
            "negate the accelerations: at rest an accelerometer reads +9.81 m/s² upwards"
            if tilt_deg > 180 - TILT_DEG
            else "turn the world of the ground truth, or write gravity_aligned: false"
        )
    else:
        return
    yield stream.finding(
        "gravity-direction",
        Severity.ERROR,
        what,
        remedy,
        value=tilt_deg,
        unit="deg",
        expected=f"up within {TILT_DEG:g} deg",
    )
