"""The world: a room of 8 x 6 x 3 m with furniture, made of textured rectangles.

World frame: origin in the middle of the floor, x along the 8 m, z up, metres. Everything that senses the room
(cameras, LiDAR) sees the same :class:`Face` list, so all sensors agree exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from slamhive.recordings.geometry import Array, rotation_xyz

ROOM_SIZE_M = (8.0, 6.0, 3.0)


class Material(StrEnum):
    """Kind of paint of a surface."""

    BRICK = "brick"
    WALLPAPER = "wallpaper"
    FLOOR = "floor"
    CEILING = "ceiling"
    WOOD = "wood"
    BOOKS = "books"
    CRATE = "crate"
    FABRIC = "fabric"
    POSTER = "poster"


@dataclass(frozen=True, eq=False)
class Face:
    """A one-sided rectangle. ``u`` runs right and ``v`` down as seen from the visible side, where ``normal`` points.

    ``corner_m`` is the upper left corner, ``reflectivity`` (0..1) what the LiDAR's intensity shows.
    """

    name: str
    material: Material
    corner_m: Array
    u: Array
    v: Array
    width_m: float
    height_m: float
    reflectivity: float = 0.5
    normal: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "normal", np.cross(self.v, self.u))

    @property
    def corners_m(self) -> Array:
        """The four corners, (4, 3), clockwise from the upper left."""
        right, down = self.u * self.width_m, self.v * self.height_m
        return np.stack([self.corner_m, self.corner_m + right, self.corner_m + right + down, self.corner_m + down])


@dataclass(frozen=True, slots=True)
class Box:
    """A piece of furniture: ``base_m`` is the middle of its bottom, ``size_m`` its extent along x, y, z before yaw."""

    name: str
    base_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    material: Material
    yaw_rad: float = 0.0


FURNITURE = (
    Box("shelf_north", (-1.6, 2.8, 0.0), (2.2, 0.35, 2.1), Material.BOOKS),
    Box("shelf_east", (3.8, 1.4, 0.0), (0.36, 1.8, 2.0), Material.BOOKS),
    Box("wardrobe", (-3.65, -1.6, 0.0), (0.6, 1.6, 2.2), Material.WOOD),
    Box("sofa", (0.9, -2.65, 0.0), (2.1, 0.6, 0.75), Material.FABRIC),
    Box("sofa_back", (0.9, -2.9, 0.75), (2.1, 0.15, 0.35), Material.FABRIC),
    Box("table", (0.1, 0.05, 0.0), (1.1, 0.7, 0.75), Material.WOOD, 0.3),
    Box("crate_on_table", (0.2, 0.1, 0.75), (0.36, 0.3, 0.28), Material.CRATE, 0.9),
    Box("crate_corner", (3.4, -2.45, 0.0), (0.8, 0.7, 0.8), Material.CRATE, 0.25),
    Box("crate_stacked", (3.45, -2.5, 0.8), (0.5, 0.5, 0.5), Material.CRATE, -0.2),
    Box("chest", (-3.45, 2.35, 0.0), (0.7, 0.8, 0.9), Material.CRATE, -0.15),
    Box("pillar", (2.0, 2.65, 0.0), (0.4, 0.4, 3.0), Material.BRICK),
    Box("cabinet", (-1.5, -2.8, 0.0), (1.2, 0.4, 1.0), Material.WOOD),
    Box("board_north", (0.6, 2.98, 1.0), (1.4, 0.04, 1.1), Material.POSTER),
    Box("board_south", (-1.5, -2.98, 1.3), (1.3, 0.04, 1.0), Material.POSTER),
    Box("board_west", (-3.98, 0.8, 1.0), (0.04, 1.5, 1.1), Material.POSTER),
    Box("board_east", (3.98, -0.6, 0.9), (0.04, 1.5, 1.2), Material.POSTER),
)

_REFLECTIVITY = {
    Material.BRICK: 0.35,
    Material.WALLPAPER: 0.6,
    Material.FLOOR: 0.4,
    Material.CEILING: 0.85,
    Material.WOOD: 0.5,
    Material.BOOKS: 0.45,
    Material.CRATE: 0.55,
    Material.FABRIC: 0.25,
    Material.POSTER: 0.7,
}

_UP = np.array([0.0, 0.0, 1.0])


def room_faces() -> tuple[Face, ...]:
    """All visible surfaces: the room's six from inside, the furniture's from outside."""
    length, width, height = ROOM_SIZE_M
    x, y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    middle = _UP * height / 2
    faces = [
        _upright("wall_east", Material.WALLPAPER, middle + x * length / 2, -x, (width, height)),
        _upright("wall_west", Material.BRICK, middle - x * length / 2, x, (width, height)),
        _upright("wall_north", Material.BRICK, middle + y * width / 2, -y, (length, height)),
        _upright("wall_south", Material.WALLPAPER, middle - y * width / 2, y, (length, height)),
        _rectangle("floor", Material.FLOOR, np.zeros(3), (x, -y), (length, width)),
        _rectangle("ceiling", Material.CEILING, _UP * height, (x, y), (length, width)),
    ]
    for box in FURNITURE:
        R = rotation_xyz(0.0, 0.0, box.yaw_rad)
        x, y = R[:, 0], R[:, 1]
        length, width, height = box.size_m
        base = np.array(box.base_m)
        middle = base + _UP * height / 2
        top_material = Material.WOOD if box.material is Material.BOOKS else box.material
        faces.extend(
            [
                _upright(f"{box.name}_front", box.material, middle + x * length / 2, x, (width, height)),
                _upright(f"{box.name}_rear", box.material, middle - x * length / 2, -x, (width, height)),
                _upright(f"{box.name}_left", box.material, middle + y * width / 2, y, (length, height)),
                _upright(f"{box.name}_right", box.material, middle - y * width / 2, -y, (length, height)),
                _rectangle(f"{box.name}_top", top_material, base + _UP * height, (x, -y), (length, width)),
                _rectangle(f"{box.name}_bottom", top_material, base, (x, y), (length, width)),
            ]
        )
    return tuple(faces)


def clearance_m(point_m: Array) -> float:
    """Distance of a point (3,) to the nearest surface of furniture or room; negative inside furniture."""
    half = np.array([ROOM_SIZE_M[0] / 2, ROOM_SIZE_M[1] / 2, ROOM_SIZE_M[2] / 2])
    centre = np.array([0.0, 0.0, half[2]])
    distances = [float(np.min(half - np.abs(point_m - centre)))]
    for box in FURNITURE:
        R_world_box = rotation_xyz(0.0, 0.0, box.yaw_rad)
        middle = np.array(box.base_m) + np.array([0.0, 0.0, box.size_m[2] / 2])
        outside = np.abs(R_world_box.T @ (point_m - middle)) - np.array(box.size_m) / 2
        distances.append(float(np.linalg.norm(np.maximum(outside, 0.0)) + min(float(np.max(outside)), 0.0)))
    return min(distances)


def _upright(name: str, material: Material, centre_m: Array, normal: Array, size_m: tuple[float, float]) -> Face:
    return _rectangle(name, material, centre_m, (np.cross(-normal, _UP), -_UP), size_m)


def _rectangle(
    name: str, material: Material, centre_m: Array, axes: tuple[Array, Array], size_m: tuple[float, float]
) -> Face:
    u, v = axes
    width, height = size_m
    corner = centre_m - u * width / 2 - v * height / 2
    return Face(name, material, corner, u, v, width, height, _REFLECTIVITY[material])


# The room's surfaces as a cloud of points: the reference that maps are compared with.


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
    """Tell if each point, (n, 3), is in the room and in no piece of furniture."""
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
