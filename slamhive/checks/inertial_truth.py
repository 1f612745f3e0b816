"""The IMU against the ground truth: clocks, units, axes and the direction of gravity.

The magnitude of the angular rate depends neither on frames nor on the order of quaternions, and shows time offset and
unit. Once these are right, the vectors show axes, order and direction of the orientations.
"""

from __future__ import annotations

import numpy as np

from slamhive.checks.angular_rates import FEWEST_CELLS, MOST_CELLS, RatePair, best_turn, misfit_of, pair_rates, rms
from slamhive.checks.evidence import TRUTH, Evidence, Findings, Stream
from slamhive.checks.geometry import matrix
from slamhive.checks.timestamps import jumps
from slamhive.checks.truth_file import usable_poses, with_quats
from slamhive.domain.checks import Finding, NotChecked, Severity
from slamhive.domain.sensors import SensorKind
from slamhive.trajectory.interpolation import interpolate
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import inverse_quats, rotations_from_quats

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


def imu_and_truth(evidence: Evidence) -> Findings:
    """Compare each IMU with the ground truth."""
    for stream in evidence.of_kind(SensorKind.IMU):
        poses = _why_not(stream) or usable_poses(evidence)
        if isinstance(poses, str):
            for check in CHECKS:
                yield NotChecked(check, stream.sensor.name, poses)
            continue
        yield from _compare(evidence, stream, poses)


def _why_not(stream: Stream) -> str | None:
    if stream.imu is None or not stream.header_ns.any():
        return "the IMU cannot be read"
    if jumps(stream).any():
        return "the clock of the IMU jumps"
    return None


def _compare(evidence: Evidence, stream: Stream, poses: Trajectory) -> Findings:
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
        yield _offset(stream, offset_s)
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


def _offset(stream: Stream, offset_s: float) -> Finding:
    name, direction = stream.sensor.name, "ahead of" if offset_s < 0 else "behind"
    return stream.finding(
        "imu-time-offset",
        Severity.ERROR if abs(offset_s) > LARGE_OFFSET_S else Severity.WARNING,
        f"The clock of {name} is {abs(offset_s) * 1e3:.0f} ms {direction} that of the ground truth.",
        f"add {offset_s:+.4f} s to the timestamps of the IMU, or subtract it from those of the ground truth",
        value=offset_s,
        unit="s",
        expected=f"within {OFFSET_S} s",
    )


def _units(stream: Stream, ratio: float) -> Finding | None:
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


def _axes(stream: Stream, poses: Trajectory, pair: RatePair, offset_s: float) -> Findings:
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


def _reread(stream: Stream, poses: Trajectory, offset_s: float, most: float) -> tuple[str, str] | None:
    """What is wrong with the quaternions, if reading them otherwise leaves a misfit of at most ``most``."""
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


def _gravity_direction(evidence: Evidence, stream: Stream, poses: Trajectory, offset_s: float) -> Findings:
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
