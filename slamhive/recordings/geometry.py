"""Rotations and rigid transforms as numpy arrays; quaternions are x, y, z, w."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slamhive.runtime.trajectory import quaternions_xyzw

if TYPE_CHECKING:
    # Images of algorithms train on rendered rooms, and have no domain.
    from slamhive.domain.sensors import Matrix4

Array = NDArray[Any]


def rotation_xyz(roll_rad: Array | float, pitch_rad: Array | float, yaw_rad: Array | float) -> Array:
    """``Rz(yaw) Ry(pitch) Rx(roll)`` for scalars or arrays of shape (n,); returns (..., 3, 3)."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows, dtype=np.float64), (0, 1), (-2, -1))


def transform(R: Array, t: Array | list[float]) -> Array:
    """The 4x4 transform with rotation ``R`` (3, 3) and translation ``t`` (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def flat(T: Array) -> Matrix4:
    """The 16 numbers of a transform by rows, as a sensor of ``dataset.yaml`` has them."""
    return tuple(T.reshape(-1).tolist())


def quaternions_from_rotations(R: Array) -> Array:
    """Unit quaternions (n, 4) of rotations (n, 3, 3), the sign chosen so that neighbours never flip."""
    quats = quaternions_xyzw(R)
    dots = np.sum(quats[1:] * quats[:-1], axis=1)
    quats[1:] *= np.cumprod(np.where(dots < 0, -1.0, 1.0))[:, None]
    return quats


# Positions of satellite receivers in a local frame: WGS 84 to east, north, up.


_SEMI_MAJOR_M = 6_378_137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY2 = _FLATTENING * (2 - _FLATTENING)


def enu_m(latitude_deg: Array, longitude_deg: Array, altitude_m: Array) -> Array:
    """Positions (n, 3) east, north and up of the first one, of geodetic coordinates (n,) each on the WGS 84 ellipsoid.

    Geodetic to earth-centred, and that to the tangent plane: Hofmann-Wellenhof et al., "GNSS", 2008, section 8.2.
    """
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg)
    normal_m = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(phi) ** 2)
    around_m = (normal_m + altitude_m) * np.cos(phi)
    polar_m = (normal_m * (1 - _ECCENTRICITY2) + altitude_m) * np.sin(phi)
    centred_m = np.stack([around_m * np.cos(lam), around_m * np.sin(lam), polar_m], axis=1)
    (sin_phi, cos_phi), (sin_lam, cos_lam) = ((np.sin(angle[0]), np.cos(angle[0])) for angle in (phi, lam))
    R_enu_ecef = np.array(
        [
            [-sin_lam, cos_lam, 0.0],
            [-sin_phi * cos_lam, -sin_phi * sin_lam, cos_phi],
            [cos_phi * cos_lam, cos_phi * sin_lam, sin_phi],
        ]
    )
    local_m: Array = (centred_m - centred_m[0]) @ R_enu_ecef.T
    return local_m
