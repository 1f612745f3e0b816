"""Positions of satellite receivers in a local frame: WGS 84 to east, north, up."""

from __future__ import annotations

import numpy as np

from slamhive.bags.geometry import Array

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
