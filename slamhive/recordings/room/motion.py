"""The trajectory of the body through the room: smooth, analytic, from rest back to where it began.

Positions and angles are sums of sines of a phase that a smooth time law drives. Second-order forward
differentiation (:class:`Jet`) gives exact first and second derivatives, so the IMU agrees with the ground truth up to
rounding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamhive.recordings.geometry import Array, rotation_xyz

LAP_S = 13.0
"""Time of one lap around the room; shorter sequences go out along the loop and come back."""
_REST_S = 1.2
_RAMP_S = 1.5
_LOOP_RADII_M = (1.9, 1.25)
_LOOP_HEIGHT_M = 1.4
_SHAKES_M = ((0.07, 0.83, 0.4), (0.07, 0.71, 1.1), (0.09, 0.97, 2.0))
"""Amplitude, frequency in Hz and phase of the sway along x, y, z: what an IMU needs to observe gravity and scale."""
_TILTS_RAD = ((0.09, 0.61, 0.3), (0.08, 0.53, 1.7), (0.10, 0.37, 0.9))
"""Amplitude, frequency and phase of roll, pitch and yaw."""


@dataclass(frozen=True, eq=False)
class Jet:
    """A function of time with its first and second derivative, sampled at n instants: three arrays (n,)."""

    value: Array
    rate: Array
    rate2: Array

    def __add__(self, other: Jet | float) -> Jet:
        if isinstance(other, Jet):
            return Jet(self.value + other.value, self.rate + other.rate, self.rate2 + other.rate2)
        return Jet(self.value + other, self.rate, self.rate2)

    def __mul__(self, other: Jet | float) -> Jet:
        if isinstance(other, Jet):
            return Jet(
                self.value * other.value,
                self.rate * other.value + self.value * other.rate,
                self.rate2 * other.value + 2 * self.rate * other.rate + self.value * other.rate2,
            )
        return Jet(self.value * other, self.rate * other, self.rate2 * other)

    def sin(self) -> Jet:
        """The sine of this function."""
        return self.compose(np.sin(self.value), np.cos(self.value), -np.sin(self.value))

    def cos(self) -> Jet:
        """The cosine of this function."""
        return self.compose(np.cos(self.value), -np.sin(self.value), -np.cos(self.value))

    def compose(self, f: Array, df: Array, d2f: Array) -> Jet:
        """f(this function), given f and its two derivatives at ``value`` (chain rule)."""
        return Jet(f, df * self.rate, d2f * self.rate**2 + df * self.rate2)


@dataclass(frozen=True, eq=False)
class RoomMotion:
    """The body at n instants, in the world frame unless said otherwise.

    ``R_world_body`` (n, 3, 3), ``positions_m``, ``velocities_mps``, ``accelerations_mps2`` (n, 3) and
    ``rates_body_radps`` (n, 3), the angular velocity in the body frame.
    """

    R_world_body: Array
    positions_m: Array
    velocities_mps: Array
    accelerations_mps2: Array
    rates_body_radps: Array

    def T_world_body(self, index: int) -> Array:
        """The pose at one instant, (4, 4)."""
        T = np.eye(4)
        T[:3, :3] = self.R_world_body[index]
        T[:3, 3] = self.positions_m[index]
        return T


def motion_at(times_s: Array, duration_s: float) -> RoomMotion:
    """The motion of a sequence of ``duration_s`` at ``times_s`` (n,), seconds since its start.

    Times outside 0..duration are at rest.
    """
    time = Jet(np.asarray(times_s, dtype=np.float64), np.ones(len(times_s)), np.zeros(len(times_s)))
    law = _TimeLaw(duration_s)
    phase = law.phase(time)
    activity = law.activity(time)
    position = [
        phase.cos() * _LOOP_RADII_M[0] + activity * _sine(time, _SHAKES_M[0]),
        phase.sin() * _LOOP_RADII_M[1] + activity * _sine(time, _SHAKES_M[1]),
        (phase * 2.0).sin() * 0.12 + activity * _sine(time, _SHAKES_M[2]) + _LOOP_HEIGHT_M,
    ]
    roll, pitch, sway = (activity * _sine(time, tilt) for tilt in _TILTS_RAD)
    yaw = phase + sway + math.pi / 2
    return RoomMotion(
        R_world_body=rotation_xyz(roll.value, pitch.value, yaw.value),
        positions_m=np.stack([axis.value for axis in position], axis=1),
        velocities_mps=np.stack([axis.rate for axis in position], axis=1),
        accelerations_mps2=np.stack([axis.rate2 for axis in position], axis=1),
        rates_body_radps=_body_rates(roll, pitch, yaw),
    )


@dataclass(frozen=True, slots=True)
class _TimeLaw:
    """Rest, acceleration, steady motion, deceleration, rest; all phases shrink with very short sequences."""

    duration_s: float

    @property
    def _rest_s(self) -> float:
        return min(_REST_S, 0.1 * self.duration_s)

    @property
    def _ramp_s(self) -> float:
        return min(_RAMP_S, 0.2 * self.duration_s)

    def activity(self, time: Jet) -> Jet:
        """0 at rest, 1 while moving; less in sequences too short to reach it gently."""
        rise, fall = self._edges(time)
        gentle = (self._ramp_s / _RAMP_S) ** 2
        return _step(rise) * (_step(fall) * -1.0 + 1.0) * gentle

    def phase(self, time: Jet) -> Jet:
        """Angle along the loop in rad: whole laps, or out and back where there is no time for one."""
        rise, fall = self._edges(time)
        moving_s = self.duration_s - 2 * self._rest_s - self._ramp_s
        progress = (_ramp(rise) + _ramp(fall) * -1.0) * (self._ramp_s / moving_s)
        laps = round(moving_s / LAP_S)
        if laps > 0:
            return progress * (2 * math.pi * laps)
        reach_rad = math.pi * moving_s / LAP_S
        return (progress * (2 * math.pi)).cos() * (-reach_rad / 2) + reach_rad / 2

    def _edges(self, time: Jet) -> tuple[Jet, Jet]:
        """Time since moving off and since braking, in ramp lengths."""
        scale = 1 / self._ramp_s
        braking_s = self.duration_s - self._rest_s - self._ramp_s
        return (time + -self._rest_s) * scale, (time + -braking_s) * scale


def _step(x: Jet) -> Jet:
    """0 below 0, 1 above 1, and 10x³ - 15x⁴ + 6x⁵ between: twice continuously differentiable."""
    t = np.clip(x.value, 0.0, 1.0)
    return x.compose(t**3 * (10 - 15 * t + 6 * t**2), 30 * t**2 * (1 - t) ** 2, 60 * t * (1 - t) * (1 - 2 * t))


def _ramp(x: Jet) -> Jet:
    """The integral of :func:`_step`: 0 below 0, x - 1/2 above 1."""
    t = np.clip(x.value, 0.0, 1.0)
    step = _step(x)
    value = t**4 * (2.5 - 3 * t + t**2) + np.maximum(x.value - 1.0, 0.0)
    inside = 30 * t**2 * (1 - t) ** 2
    return x.compose(value, step.value, inside)


def _sine(time: Jet, wave: tuple[float, float, float]) -> Jet:
    amplitude, frequency_hz, phase_rad = wave
    return (time * (2 * math.pi * frequency_hz) + phase_rad).sin() * amplitude


def _body_rates(roll: Jet, pitch: Jet, yaw: Jet) -> Array:
    """Angular velocity in the body frame from z-y-x Euler angles (Diebel 2006, "Representing Attitude")."""
    sr, cr = np.sin(roll.value), np.cos(roll.value)
    sp, cp = np.sin(pitch.value), np.cos(pitch.value)
    return np.stack(
        [
            roll.rate - sp * yaw.rate,
            cr * pitch.rate + sr * cp * yaw.rate,
            -sr * pitch.rate + cr * cp * yaw.rate,
        ],
        axis=1,
    )
