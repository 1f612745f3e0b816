"""The inertial sensor: specific force and angular rate of the body, with white noise and drifting biases.

Noise model as in Kalibr and Forster et al. 2017: a sample is the true value plus bias plus white noise of standard
deviation density / sqrt(dt); each bias is a random walk with steps of standard deviation walk * sqrt(dt).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamhive.bags.geometry import Array
from slamhive.bags.room.motion import Motion

GRAVITY_MPS2 = 9.81


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Densities in SI units: rad/s/√Hz, m/s²/√Hz, rad/s²/√Hz, m/s³/√Hz; initial biases are drawn once."""

    gyroscope_noise_density: float = 1.7e-4
    accelerometer_noise_density: float = 2.0e-3
    gyroscope_random_walk: float = 2.0e-5
    accelerometer_random_walk: float = 3.0e-3
    gyroscope_initial_bias: float = 3.0e-3
    accelerometer_initial_bias: float = 3.0e-2


NO_NOISE = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """``rates_radps`` and ``specific_forces_mps2``, each (n, 3), in the body frame."""

    rates_radps: Array
    specific_forces_mps2: Array


def measure(motion: Motion, rate_hz: float, noise: ImuNoise, rng: np.random.Generator) -> ImuSamples:
    """What the IMU at the body's origin reads at the instants of ``motion``."""
    upward = motion.accelerations_mps2 + np.array([0.0, 0.0, GRAVITY_MPS2])
    forces = np.einsum("nji,nj->ni", motion.R_world_body, upward)
    dt_s = 1.0 / rate_hz
    return ImuSamples(
        motion.rates_body_radps
        + _errors(
            len(forces),
            dt_s,
            (noise.gyroscope_noise_density, noise.gyroscope_random_walk, noise.gyroscope_initial_bias),
            rng,
        ),
        forces
        + _errors(
            len(forces),
            dt_s,
            (noise.accelerometer_noise_density, noise.accelerometer_random_walk, noise.accelerometer_initial_bias),
            rng,
        ),
    )


def _errors(count: int, dt_s: float, levels: tuple[float, float, float], rng: np.random.Generator) -> Array:
    density, walk, initial = levels
    white = rng.standard_normal((count, 3)) * (density / np.sqrt(dt_s))
    steps = rng.standard_normal((count, 3)) * (walk * np.sqrt(dt_s))
    errors: Array = white + np.cumsum(steps, axis=0) + rng.standard_normal(3) * initial
    return errors
