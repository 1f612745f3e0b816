"""Rendering: what a pinhole camera in the room sees, as a grey image and as depth.

Every face is a plane, so its inverse depth, and its texture coordinates divided by depth, are affine in the pixel
coordinates. With the ray d = ((x-cx)/fx, (y-cy)/fy, 1) and a plane n·p = c seen from the camera centre, 1/z = (n·d)/c.
Visibility is a comparison of inverse depths, texturing is a homography. Each face is restricted to
the rectangle its clipped outline projects to. Pixel centres have integer coordinates, as in OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slamhive.recordings.geometry import Array
from slamhive.recordings.room.texture import MIP_LEVELS, Texture, paint
from slamhive.recordings.room.world import Face, room_faces

NEAR_M = 0.02
_LENS_BLUR_PX = 0.5
_SHARPNESS_LEVELS = 0.2
"""Levels added to the mip level: a little blur instead of shimmer on slanted surfaces."""


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera without distortion; pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def matrix(self) -> Array:
        """The 3x3 intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class View:
    """One rendering: ``grey`` float32 (height, width) in 0..255 without noise, ``depth_m`` float32 along z."""

    grey: Array
    depth_m: Array


@dataclass(frozen=True, eq=False)
class _Projected:
    """A face as one camera sees it: rows of ``affine`` give u/z, v/z and 1/z for (x, y, 1); the rectangle it is in."""

    affine: Array
    columns: slice
    rows: slice


class Renderer:
    """Renders the room of one seed; a surface is painted when it is first seen, so keep the renderer.

    Args:
        seed: What the surfaces look like.
    """

    def __init__(self, seed: int) -> None:
        self._faces = room_faces()
        self._seed = seed
        self._textures: dict[int, Texture] = {}

    def view(self, T_world_camera: Array, camera: Camera) -> View:
        """Render the view of ``camera`` at ``T_world_camera`` (4, 4; optical frame: x right, y down, z forward)."""
        nearness = np.zeros((camera.height, camera.width), dtype=np.float32)
        owner = np.full((camera.height, camera.width), -1, dtype=np.int16)
        projected: dict[int, _Projected] = {}
        for index, face in enumerate(self._faces):
            place = _project(face, T_world_camera, camera)
            if place is not None:
                projected[index] = place
                _claim(place, face, index, nearness, owner)
        grey: Array = np.zeros((camera.height, camera.width), dtype=np.float32)
        for index, place in projected.items():
            visible = owner[place.rows, place.columns] == index
            if visible.any():
                if index not in self._textures:
                    self._textures[index] = paint(self._faces[index], self._seed, index)
                _shade(place, self._textures[index], visible, nearness, grey)
        grey = cv2.GaussianBlur(grey, (3, 3), _LENS_BLUR_PX)
        depth = np.divide(np.float32(1.0), nearness, out=np.zeros_like(nearness), where=nearness > 0)
        return View(grey, depth)


def _project(face: Face, T_world_camera: Array, camera: Camera) -> _Projected | None:
    R_camera_world = T_world_camera[:3, :3].T
    corner = R_camera_world @ (face.corner_m - T_world_camera[:3, 3])
    u, v = R_camera_world @ face.u, R_camera_world @ face.v
    normal = np.cross(v, u)
    offset = float(normal @ corner)
    if offset > -1e-6:
        return None
    right, down = u * face.width_m, v * face.height_m
    outline = _clip_near(np.stack([corner, corner + right, corner + right + down, corner + down]))
    if len(outline) == 0:
        return None
    x = camera.fx * outline[:, 0] / outline[:, 2] + camera.cx
    y = camera.fy * outline[:, 1] / outline[:, 2] + camera.cy
    columns, rows = _span(x, camera.width), _span(y, camera.height)
    if columns.start >= columns.stop or rows.start >= rows.stop:
        return None
    inverse = np.linalg.inv(camera.matrix)
    over_z = normal / offset
    affine = np.stack([u - (u @ corner) * over_z, v - (v @ corner) * over_z, over_z]) @ inverse
    return _Projected(affine, columns, rows)


def _clip_near(outline: Array) -> Array:
    """The part of a convex polygon (n, 3) in front of the near plane (Sutherland and Hodgman 1974)."""
    kept: list[Array] = []
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        start_in, end_in = start[2] > NEAR_M, end[2] > NEAR_M
        if start_in:
            kept.append(start)
        if start_in != end_in:
            kept.append(start + (end - start) * ((NEAR_M - start[2]) / (end[2] - start[2])))
    return np.array(kept)


def _span(values: Array, size: int) -> slice:
    low = max(0, int(np.floor(np.clip(values.min(), -1, size))))
    high = min(size, int(np.ceil(np.clip(values.max(), -1, size))) + 1)
    return slice(low, high)


def _plane(coefficients: Array, place: _Projected) -> Array:
    """``a x + b y + c`` over the rectangle, float32; the coordinates stay float64 until the sum's last step."""
    x = np.arange(place.columns.start, place.columns.stop)
    y = np.arange(place.rows.start, place.rows.stop)
    across = (coefficients[0] * x + coefficients[2]).astype(np.float32)
    down = (coefficients[1] * y).astype(np.float32)
    plane: Array = across[None, :] + down[:, None]
    return plane


def _claim(place: _Projected, face: Face, index: int, nearness: Array, owner: Array) -> None:
    """Where ``face`` is nearer than what is there, write its inverse depth and its index."""
    window = nearness[place.rows, place.columns]
    inverse_z = _plane(place.affine[2], place)
    u = _plane(place.affine[0], place)
    v = _plane(place.affine[1], place)
    slack = inverse_z * np.float32(1e-5)
    wins = inverse_z > window
    wins &= u >= -slack
    wins &= v >= -slack
    wins &= u <= inverse_z * np.float32(face.width_m) + slack
    wins &= v <= inverse_z * np.float32(face.height_m) + slack
    window[wins] = inverse_z[wins]
    owner[place.rows, place.columns][wins] = index


def _shade(place: _Projected, texture: Texture, visible: Array, nearness: Array, grey: Array) -> None:
    """Sample the texture where the face is visible, blending the two mip levels nearest to a pixel's footprint.

    The footprint is the square root of the Jacobian's determinant of (u, v) with respect to (x, y), which for
    a homography with rows (U, V, W) is det(H) / W^3.
    """
    to_texel = np.diag([1 / texture.texel_u_m, 1 / texture.texel_v_m, 1.0])
    H = to_texel @ place.affine
    rows_used = np.flatnonzero(visible.any(axis=1))
    columns_used = np.flatnonzero(visible.any(axis=0))
    rows = slice(int(rows_used[0]), int(rows_used[-1]) + 1)
    columns = slice(int(columns_used[0]), int(columns_used[-1]) + 1)
    visible = visible[rows, columns]
    top, left = place.rows.start + rows.start, place.columns.start + columns.start
    area = (slice(top, top + visible.shape[0]), slice(left, left + visible.shape[1]))
    inverse_z = np.where(visible, nearness[area], np.float32(1.0))
    level = np.float32(0.5 * np.log2(abs(np.linalg.det(H))) + _SHARPNESS_LEVELS) - np.float32(1.5) * np.log2(inverse_z)
    np.clip(level, 0, MIP_LEVELS - 1, out=level)
    in_view = level[visible]
    shifted = H @ np.array([[1.0, 0.0, left], [0.0, 1.0, top], [0.0, 0.0, 1.0]])
    colour = np.zeros(visible.shape, dtype=np.float32)
    for number in range(int(in_view.min()), int(np.ceil(in_view.max())) + 1):
        scale = 0.5**number
        centre = np.array([[scale, 0.0, -0.5], [0.0, scale, -0.5], [0.0, 0.0, 1.0]])
        sampled = cv2.warpPerspective(
            texture.levels[number],
            centre @ shifted,
            (visible.shape[1], visible.shape[0]),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        colour += sampled * np.maximum(np.float32(1.0) - np.abs(level - np.float32(number)), 0)
    np.copyto(grey[area], colour, where=visible)
