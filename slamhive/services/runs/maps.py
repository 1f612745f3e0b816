"""Saved maps for a screen, thinned on demand."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from slamhive.errors import NotFound
from slamhive.runs.point_cloud import PointCloud, map_size, sampled_cloud, thinned_cloud
from slamhive.runs.untrusted import FloatArray
from slamhive.services.kept_views import KeptViews
from slamhive.trajectory.alignment import Similarity

_CACHE_BYTES = 32_000_000
REFERENCE_POINTS = 500_000
"""A reference map is thinned to so many points before a map is compared with it."""


@dataclass(frozen=True, slots=True)
class _Key:
    """A file as it is now, and what was made of it."""

    path: Path
    modified_ns: int
    size_bytes: int
    what: str


class MapViews:
    """Points of saved maps.

    Those shown last are kept in memory, up to 32 MB: folders of runs are records, and an archive may be read-only. At
    most two maps are read at once, so visitors wait, and runs keep their CPU.
    """

    def __init__(self) -> None:
        self._kept: KeptViews[_Key, PointCloud] = KeptViews(_CACHE_BYTES, lambda cloud: cloud.size_bytes)

    def size(self, path: Path, name: str) -> int:
        """How many points the map at ``path`` has, from its header.

        Raises NotFound without the file, InvalidInput for one that cannot be used.
        """
        return map_size(path, name)

    def sample(self, path: Path, name: str) -> PointCloud:
        """A quick sample of its points; raises as :meth:`size`."""
        return self._cloud(path, name, "sample", sampled_cloud)

    def thinned(self, path: Path, name: str) -> PointCloud:
        """At most one point in each voxel; raises as :meth:`size`."""
        return self._cloud(path, name, "thinned", thinned_cloud)

    def compared(self, path: Path, name: str, reference: Path, to_reference: Similarity) -> PointCloud:
        """The thinned points with their distance to the nearest point of the reference map.

        ``to_reference`` moves the map to the frame of the reference. Raises as :meth:`size`, also for the reference.
        """
        thinned = self.thinned(path, name)
        against = _key(reference, reference.name, to_reference.matrix.tobytes().hex())

        def read(_path: Path, _name: str) -> PointCloud:
            known = thinned_cloud(reference, reference.name, REFERENCE_POINTS).positions_m
            return replace(thinned, errors_m=_distances_m(to_reference.points(thinned.positions_m), known))

        return self._cloud(path, name, str(against), read)

    def _cloud(self, path: Path, name: str, what: str, read: Callable[[Path, str], PointCloud]) -> PointCloud:
        return self._kept.get(_key(path, name, what), lambda: read(path, name))


def _distances_m(points_m: FloatArray, reference_m: FloatArray) -> FloatArray:
    """From each point to the nearest of the reference, shape (n,)."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to load, and few maps have a reference

    found: FloatArray = cKDTree(reference_m).query(points_m)[0]
    return found


def _key(path: Path, name: str, what: str) -> _Key:
    try:
        status = os.lstat(path)
    except OSError:
        raise NotFound(f"there is no file {name}") from None
    return _Key(path, status.st_mtime_ns, status.st_size, what)
