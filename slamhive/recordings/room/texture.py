"""Painted surfaces: one grey image per face with its mip levels, made from a seed.

The patterns are those of a furnished room (bricks, boards, books, posters) at several scales. Corner detectors
find structure near and far, and every place looks different from the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slamhive.recordings.geometry import Array
from slamhive.recordings.room.world import Face, Material

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
