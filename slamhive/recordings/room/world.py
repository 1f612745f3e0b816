"""The world: a room of 8 x 6 x 3 m with furniture, made of textured rectangles, and the way of the body through it.

World frame: origin in the middle of the floor, x along the 8 m, z up, metres. Everything that senses the room
(cameras, LiDAR) sees the same :class:`Face` list, so all sensors agree exactly.
"""

from __future__ import annotations

import math
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
    sizes_m = (face.width_m, face.height_m)
    counts = [max(1, int(np.ceil(size_m / spacing_m))) for size_m in sizes_m]
    along, down = ((np.arange(count) + 0.5) * size_m / count for size_m, count in zip(sizes_m, counts, strict=True))
    u, v = (values.ravel() for values in np.meshgrid(along, down))
    points_m = face.corner_m + u[:, None] * face.u + v[:, None] * face.v
    return points_m, np.broadcast_to(face.normal, points_m.shape)


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


# The trajectory of the body through the room: smooth, analytic, from rest back to where it began.
#
# Positions and angles are sums of sines of a phase that a smooth time law drives. Second-order forward differentiation
# (:class:`Jet`) gives exact first and second derivatives, so the IMU agrees with the ground truth up to rounding.


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
