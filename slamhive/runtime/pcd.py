"""Writing point clouds as PCD files (Point Cloud Library, version 0.7, ``DATA binary``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from slamhive.base.files import write_aside

MOST_POINTS = 2_000_000
"""The largest map that is written: 24 MB."""

_HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""


def format_pcd(points_m: npt.ArrayLike) -> bytes:
    """The bytes of a PCD file of ``points_m``, shape (n, 3), m; single precision."""
    points = np.ascontiguousarray(np.asarray(points_m).reshape(-1, 3), dtype="<f4")
    return _HEADER.format(count=len(points)).encode("ascii") + points.tobytes()


def write_pcd(path: Path, points_m: npt.ArrayLike) -> None:
    """Write ``points_m``, shape (n, 3), m, in one step: a reader sees the old file or the new. Raises Unavailable.

    Of more than :data:`MOST_POINTS` points, so many are written, evenly taken.
    """
    points = np.asarray(points_m).reshape(-1, 3)
    if len(points) > MOST_POINTS:
        points = points[np.linspace(0, len(points) - 1, MOST_POINTS).astype(np.int64)]
    write_aside(path, format_pcd(points))
