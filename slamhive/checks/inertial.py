"""The IMU by itself: gravity and units."""

from __future__ import annotations

import numpy as np

from slamhive.checks.evidence import Array, Evidence, Findings, Stream
from slamhive.domain.checks import NotChecked, Severity
from slamhive.domain.sensors import SensorKind

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


def gravity(evidence: Evidence) -> Findings:
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


def angular_rates(evidence: Evidence) -> Findings:
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


def _imus(evidence: Evidence) -> list[Stream]:
    return [stream for stream in evidence.of_kind(SensorKind.IMU) if stream.imu is not None]


def _samples(stream: Stream) -> Array | str:
    """The finite samples, or why they say nothing."""
    rows = np.zeros((0, 6)) if stream.imu is None else stream.imu
    finite: Array = rows[np.isfinite(rows).all(axis=1)]
    return finite if len(finite) >= FEWEST_SAMPLES else f"{len(finite)} samples are too few"
