"""Rendering: painted surfaces, and what a pinhole camera in the room sees of them, as a grey image and as depth.

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
from slamhive.recordings.room.world import Face, Material, room_faces

TEXEL_M = 0.004
MIP_LEVELS = 6
_MULTIPLE = 2 ** (MIP_LEVELS - 1)


@dataclass(frozen=True, eq=False)
class Texture:
    """Mip levels of one face: uint8 images, each half the size of the one before; texel size of level 0 in metres."""

    levels: tuple[Array, ...]
    texel_u_m: float
    texel_v_m: float


def paint(face: Face, seed: int, index: int) -> Texture:
    """The texture of ``face``, the ``index``-th of the world seeded with ``seed``."""
    width = _pixels(face.width_m)
    height = _pixels(face.height_m)
    rng = np.random.default_rng(np.random.SeedSequence([seed, 1, index]))
    canvas = np.empty((height, width), dtype=np.uint8)
    _PAINTERS[face.material](canvas, rng)
    lit = _light(canvas, rng)
    levels = [lit]
    while len(levels) < MIP_LEVELS:
        rows, columns = levels[-1].shape
        levels.append(cv2.resize(levels[-1], (columns // 2, rows // 2), interpolation=cv2.INTER_AREA))
    return Texture(tuple(levels), face.width_m / width, face.height_m / height)


def _pixels(length_m: float) -> int:
    pixels: int = max(1, -(-int(length_m / TEXEL_M) // _MULTIPLE)) * _MULTIPLE
    return pixels


def _light(canvas: Array, rng: np.random.Generator) -> Array:
    """Fine grain, and light that falls off smoothly over the surface."""
    height, width = canvas.shape
    coarse = rng.uniform(0.82, 1.08, (4, 4)).astype(np.float32)
    shade = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    grain = cv2.GaussianBlur(rng.standard_normal((height, width), dtype=np.float32), (0, 0), 1.2) * 9
    lit: Array = np.clip(canvas * shade + grain, 0, 255).astype(np.uint8)
    return lit


def _brick(canvas: Array, rng: np.random.Generator) -> None:
    canvas[:] = 165
    brick_h, brick_w, joint = 20, 56, 3
    for row, top in enumerate(range(0, canvas.shape[0], brick_h)):
        for left in range(-(row % 2) * brick_w // 2, canvas.shape[1], brick_w):
            tone = int(rng.integers(55, 140))
            cv2.rectangle(canvas, (left + joint, top + joint), (left + brick_w, top + brick_h), tone, -1)
            if rng.random() < 0.25:
                _blot(canvas, rng, (left + brick_w // 2, top + brick_h // 2), 7)


def _wallpaper(canvas: Array, rng: np.random.Generator) -> None:
    canvas[:] = 170
    for left in range(0, canvas.shape[1], 90):
        cv2.rectangle(canvas, (left, 0), (left + 44, canvas.shape[0]), int(rng.integers(140, 165)), -1)
    for top in range(20, canvas.shape[0], 52):
        for left in range(20, canvas.shape[1], 52):
            centre = (left + int(rng.integers(-12, 13)), top + int(rng.integers(-12, 13)))
            sides = int(rng.integers(3, 7))
            radius = float(rng.uniform(8, 20))
            angles = rng.uniform(0, 2 * np.pi) + np.arange(sides) * 2 * np.pi / sides
            radii = radius * rng.uniform(0.5, 1.0, sides)
            corners = np.stack([np.cos(angles) * radii, np.sin(angles) * radii], axis=1) + np.array(centre)
            cv2.fillPoly(canvas, [np.round(corners).astype(np.int32)], int(rng.integers(40, 130)), cv2.LINE_AA)
            cv2.circle(canvas, centre, 3, int(rng.integers(180, 255)), -1, cv2.LINE_AA)


def _floor(canvas: Array, rng: np.random.Generator) -> None:
    canvas[:] = 60
    for top in range(0, canvas.shape[0], 80):
        for left in range(0, canvas.shape[1], 80):
            tone = int(rng.integers(90, 200))
            cv2.rectangle(canvas, (left + 2, top + 2), (left + 77, top + 77), tone, -1)
            for _ in range(6):
                _blot(canvas, rng, (left + int(rng.integers(8, 72)), top + int(rng.integers(8, 72))), 10)


def _ceiling(canvas: Array, rng: np.random.Generator) -> None:
    canvas[:] = 205
    for top in range(0, canvas.shape[0], 150):
        cv2.line(canvas, (0, top), (canvas.shape[1], top), 120, 4)
    for left in range(0, canvas.shape[1], 150):
        cv2.line(canvas, (left, 0), (left, canvas.shape[0]), 120, 4)
    for _ in range(canvas.size // 2500):
        place = (int(rng.integers(canvas.shape[1])), int(rng.integers(canvas.shape[0])))
        cv2.circle(canvas, place, int(rng.integers(2, 7)), int(rng.integers(90, 180)), -1, cv2.LINE_AA)


def _wood(canvas: Array, rng: np.random.Generator) -> None:
    height, width = canvas.shape
    board = 36
    for left in range(0, width, board):
        canvas[:, left : left + board] = int(rng.integers(95, 150))
        for _ in range(5):
            column = left + int(rng.integers(2, board - 2))
            cv2.line(canvas, (column, 0), (column + int(rng.integers(-4, 5)), height), int(rng.integers(70, 110)), 1)
        for _ in range(1 + height // 90):
            place = (left + int(rng.integers(6, board - 6)), int(rng.integers(height)))
            axes = (int(rng.integers(3, 8)), int(rng.integers(6, 16)))
            cv2.ellipse(canvas, place, axes, 0, 0, 360, int(rng.integers(35, 70)), -1, cv2.LINE_AA)
            cv2.ellipse(canvas, place, (axes[0] + 3, axes[1] + 4), 0, 0, 360, 60, 1, cv2.LINE_AA)
        cv2.line(canvas, (left, 0), (left, height), 40, 2)


def _books(canvas: Array, rng: np.random.Generator) -> None:
    canvas[:] = 30
    shelf = 88
    for top in range(6, canvas.shape[0], shelf):
        left = 6
        while left < canvas.shape[1] - 6:
            width = int(rng.integers(7, 20))
            head = top + int(rng.integers(0, 26))
            foot = top + shelf - 10
            cv2.rectangle(canvas, (left, head), (left + width - 2, foot), int(rng.integers(50, 245)), -1)
            for _ in range(int(rng.integers(1, 4))):
                band = int(rng.integers(head, foot))
                tall = int(rng.integers(2, 9))
                cv2.rectangle(canvas, (left, band), (left + width - 2, band + tall), int(rng.integers(20, 250)), -1)
            left += width
        cv2.rectangle(canvas, (0, top + shelf - 9), (canvas.shape[1], top + shelf - 1), 150, -1)


def _crate(canvas: Array, rng: np.random.Generator) -> None:
    _wood(canvas, rng)
    height, width = canvas.shape
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), 60, 14)
    cv2.line(canvas, (0, height), (width, 0), 80, 12, cv2.LINE_AA)
    for _ in range(max(2, canvas.size // 6000)):
        _label(canvas, rng)


def _fabric(canvas: Array, rng: np.random.Generator) -> None:
    canvas[:] = 85
    for offset in range(-canvas.shape[0], canvas.shape[1], 30):
        tone = int(rng.integers(60, 190))
        cv2.line(canvas, (offset, 0), (offset + canvas.shape[0], canvas.shape[0]), tone, 7, cv2.LINE_AA)
    for offset in range(0, canvas.shape[1] + canvas.shape[0], 46):
        tone = int(rng.integers(30, 160))
        cv2.line(canvas, (offset, 0), (offset - canvas.shape[0], canvas.shape[0]), tone, 5, cv2.LINE_AA)


def _poster(canvas: Array, rng: np.random.Generator) -> None:
    height, width = canvas.shape
    canvas[:] = int(rng.integers(190, 235))
    for _ in range(canvas.size // 1800):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        tone = int(rng.integers(0, 256))
        if rng.random() < 0.5:
            far = (x + int(rng.integers(8, 50)), y + int(rng.integers(8, 50)))
            cv2.rectangle(canvas, (x, y), far, tone, -1)
        else:
            cv2.circle(canvas, (x, y), int(rng.integers(5, 24)), tone, -1, cv2.LINE_AA)
    for _ in range(canvas.size // 8000):
        _label(canvas, rng)
    cv2.rectangle(canvas, (0, 0), (width - 1, height - 1), 25, 10)


def _label(canvas: Array, rng: np.random.Generator) -> None:
    letters = "".join(chr(65 + int(code)) for code in rng.integers(0, 26, int(rng.integers(2, 6))))
    place = (int(rng.integers(canvas.shape[1])), int(rng.integers(canvas.shape[0])))
    tone = int(rng.choice([10, 245]))
    cv2.putText(canvas, letters, place, cv2.FONT_HERSHEY_SIMPLEX, float(rng.uniform(0.5, 1.1)), tone, 2, cv2.LINE_AA)


def _blot(canvas: Array, rng: np.random.Generator, centre: tuple[int, int], largest: int) -> None:
    axes = (int(rng.integers(2, largest)), int(rng.integers(2, largest)))
    tone = int(rng.integers(30, 230))
    cv2.ellipse(canvas, centre, axes, float(rng.uniform(0, 180)), 0, 360, tone, -1, cv2.LINE_AA)


_PAINTERS = {
    Material.BRICK: _brick,
    Material.WALLPAPER: _wallpaper,
    Material.FLOOR: _floor,
    Material.CEILING: _ceiling,
    Material.WOOD: _wood,
    Material.BOOKS: _books,
    Material.CRATE: _crate,
    Material.FABRIC: _fabric,
    Material.POSTER: _poster,
}


# The renderer.


NEAR_M = 0.02
_ROUNDING_M = 1e-3
"""Faces that are this near to being seen are looked at exactly."""
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
        self._normals = np.array([face.normal for face in self._faces])
        self._outlines_m = np.array([face.corners_m for face in self._faces])

    def view(self, T_world_camera: Array, camera: Camera) -> View:
        """Render the view of ``camera`` at ``T_world_camera`` (4, 4; optical frame: x right, y down, z forward)."""
        nearness = np.zeros((camera.height, camera.width), dtype=np.float32)
        owner = np.full((camera.height, camera.width), -1, dtype=np.int16)
        projected: dict[int, _Projected] = {}
        for index in self.perhaps_seen(T_world_camera, camera):
            face = self._faces[index]
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

    def perhaps_seen(self, T_world_camera: Array, camera: Camera) -> list[int]:
        """Numbers of the faces that may be in the picture. Most are seen from behind, or lie beside it."""
        offsets_m = self._outlines_m - T_world_camera[:3, 3]
        facing = np.einsum("ij,ij->i", offsets_m[:, 0], self._normals) < _ROUNDING_M
        x, y, z = np.moveaxis(offsets_m @ T_world_camera[:3, :3], 2, 0)
        left, right = -(camera.cx + 1) / camera.fx, (camera.width - camera.cx + 1) / camera.fx
        top, bottom = -(camera.cy + 1) / camera.fy, (camera.height - camera.cy + 1) / camera.fy
        inward = (z - NEAR_M, x - left * z, right * z - x, y - top * z, bottom * z - y)
        before = [np.any(distance > -_ROUNDING_M, axis=1) for distance in inward]
        return [int(index) for index in np.flatnonzero(facing & np.logical_and.reduce(before))]


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
