"""The room's surfaces as a cloud of points: the reference that maps are compared with."""

from __future__ import annotations

import numpy as np

from slamhive.bags.geometry import Array, rotation_xyz
from slamhive.bags.room.world import FURNITURE, ROOM_SIZE_M, Face, room_faces

REFERENCE_MAP_FILE = "reference_map.pcd"
SPACING_M = 0.02
_OUT_M = 0.005
"""A point is seen if the place so far off its surface is free."""


def sample_surfaces(spacing_m: float = SPACING_M) -> Array:
    """Points on every surface that can be seen from somewhere, (n, 3), on a grid of at most ``spacing_m``.

    What furniture covers (its undersides, the wall behind a shelf) is left out: no sensor could map it.
    """
    points, normals = zip(*(_grid(face, spacing_m) for face in room_faces()), strict=True)
    points_m, off_m = np.concatenate(points), _OUT_M * np.concatenate(normals)
    return points_m[_is_free(points_m + off_m)]


def _grid(face: Face, spacing_m: float) -> tuple[Array, Array]:
    """Points in the middle of the grid's cells, and the face's normal for each."""
    along, down = (_middles(size_m, spacing_m) for size_m in (face.width_m, face.height_m))
    u, v = (values.ravel() for values in np.meshgrid(along, down))
    points_m = face.corner_m + u[:, None] * face.u + v[:, None] * face.v
    return points_m, np.broadcast_to(face.normal, points_m.shape)


def _middles(size_m: float, spacing_m: float) -> Array:
    count = max(1, int(np.ceil(size_m / spacing_m)))
    middles: Array = (np.arange(count) + 0.5) * size_m / count
    return middles


def _is_free(points_m: Array) -> Array:
    """Whether each point, (n, 3), is in the room and in no piece of furniture."""
    length, width, height = ROOM_SIZE_M
    middle_m = np.array([0.0, 0.0, height / 2])
    free: Array = (np.abs(points_m - middle_m) < np.array([length, width, height]) / 2).all(axis=1)
    for box in FURNITURE:
        box_middle_m = np.array(box.base_m) + np.array([0.0, 0.0, box.size_m[2] / 2])
        reach_m = float(np.linalg.norm(box.size_m)) / 2
        near = np.flatnonzero((np.abs(points_m - box_middle_m) < reach_m).all(axis=1))
        in_box_m = (points_m[near] - box_middle_m) @ rotation_xyz(0.0, 0.0, box.yaw_rad)
        free[near] &= (np.abs(in_box_m) >= np.array(box.size_m) / 2).any(axis=1)
    return free
