"""Map quality: ``Map.pcd`` against the dataset's reference cloud, and its crispness without one.

Accuracy, completeness and F-score are the precision, recall and F-score of Knapitsch et al., "Tanks and Temples", ACM
Transactions on Graphics 36, 2017. The clouds are not registered with each other: the alignment of the trajectory moves
the map, so a map is not better than its poses. Mean map entropy: Droeschel and Behnke, "Efficient Continuous-time SLAM
for 3D Lidar-based Online Mapping", ICRA 2018.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamhive.domain.metrics.maps import (
    COMPARED_POINTS,
    ENTROPY_FLOOR_M,
    ENTROPY_NEIGHBOURS,
    ENTROPY_POINTS,
    ENTROPY_RADIUS_M,
    MAP_THRESHOLDS_M,
    MAP_VOXEL_M,
)
from slamhive.errors import InvalidInput
from slamhive.evaluation.evaluators.base import MAP, REFERENCE_MAP, MetricValues, Paired, absent
from slamhive.evaluation.pcd import read_pcd
from slamhive.trajectory.alignment import Similarity
from slamhive.trajectory.model import FloatArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_FARTHEST_M = 1e7
_CHUNK = 200


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points in m, shape (n, 3), one per voxel, and the tree that finds the nearest of them."""

    points_m: FloatArray
    tree: cKDTree


class MapQuality:
    """Shares within distances, mean distances, entropy."""

    keys = (
        *(
            f"map.{what}.{threshold_m * 100:g}cm"
            for threshold_m in MAP_THRESHOLDS_M
            for what in ("accuracy", "completeness", "fscore")
        ),
        "map.accuracy.mean",
        "map.completeness.mean",
        "map.chamfer",
        "map.entropy",
        "map.points",
    )

    def evaluate(self, paired: Paired) -> MetricValues:
        """Missing if the algorithm wrote no map. Without a reference cloud, only entropy and size are found."""
        return map_metrics(paired.files, paired.transform)


def map_metrics(files: Mapping[str, Path], transform: Similarity | None) -> MetricValues:
    """The metrics of the map in ``files``, moved into the world of the reference cloud by ``transform``.

    Without a transform, which needs a ground-truth trajectory, the map is not compared.
    """
    path = files.get(MAP)
    if path is None:
        return absent(MapQuality.keys, "the algorithm wrote no Map.pcd")
    points_m = read_pcd(path, path.name)
    cloud = make_cloud(points_m if transform is None else transform.points(points_m))
    values = {"map.points": float(len(points_m))}
    missing: dict[str, str] = {}
    entropy = map_entropy(cloud)
    if entropy is None:
        missing["map.entropy"] = (
            f"no point of the map has {ENTROPY_NEIGHBOURS} neighbours within {ENTROPY_RADIUS_M:g} m"
        )
    else:
        values["map.entropy"] = entropy
    reference = files.get(REFERENCE_MAP)
    compared = [key for key in MapQuality.keys if key not in ("map.entropy", "map.points")]
    if reference is None:
        missing |= dict.fromkeys(compared, "the dataset has no reference cloud")
    elif transform is None:
        missing |= dict.fromkeys(compared, "without a ground-truth trajectory nothing moves the map to the reference")
    else:
        values |= compare(cloud, _reference_cloud(reference))
    return MetricValues(values, missing)


def compare(cloud: Cloud, reference: Cloud) -> dict[str, float]:
    """Metrics of a map against its reference, both in one frame."""
    to_reference_m, _ = reference.tree.query(spread(cloud.points_m, COMPARED_POINTS))
    to_map_m, _ = cloud.tree.query(spread(reference.points_m, COMPARED_POINTS))
    values: dict[str, float] = {}
    for threshold_m in MAP_THRESHOLDS_M:
        ending = f"{threshold_m * 100:g}cm"
        accuracy = float(np.mean(to_reference_m <= threshold_m))
        completeness = float(np.mean(to_map_m <= threshold_m))
        both = accuracy + completeness
        values[f"map.accuracy.{ending}"] = accuracy
        values[f"map.completeness.{ending}"] = completeness
        values[f"map.fscore.{ending}"] = 2 * accuracy * completeness / both if both > 0 else 0.0
    values["map.accuracy.mean"] = float(to_reference_m.mean())
    values["map.completeness.mean"] = float(to_map_m.mean())
    values["map.chamfer"] = (values["map.accuracy.mean"] + values["map.completeness.mean"]) / 2
    return values


def map_entropy(cloud: Cloud) -> float | None:
    """Mean of 0.5 ln det(2 pi e C) over points and the covariances C of their neighbours; None if none has enough."""
    centres_m = spread(cloud.points_m, ENTROPY_POINTS)
    total, count = 0.0, 0
    for start in range(0, len(centres_m), _CHUNK):
        covariances = _neighbour_covariances(cloud, centres_m[start : start + _CHUNK])
        _, logarithms = np.linalg.slogdet(2 * np.pi * np.e * covariances)
        total, count = total + 0.5 * float(logarithms.sum()), count + len(covariances)
    return total / count if count else None


def make_cloud(points_m: FloatArray) -> Cloud:
    """Thin the points to their mean in each voxel. Raises InvalidInput if none is near enough to be a map's."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to load, and few runs have maps

    near = points_m[(np.abs(points_m) < _FARTHEST_M).all(axis=1)]
    if len(near) == 0:
        raise InvalidInput(f"every point of the map is further than {_FARTHEST_M:g} m away", "the map diverged")
    thinned = thin(near, MAP_VOXEL_M)
    return Cloud(thinned, cKDTree(thinned))


def thin(points_m: FloatArray, voxel_m: float) -> FloatArray:
    """The mean of the points in each voxel, shape (m, 3), in the order of the voxels."""
    cells = np.floor(points_m / voxel_m).astype(np.int64)
    ids = np.zeros(len(points_m), dtype=np.int64)
    for axis in range(3):
        # Each axis gets its own numbers, so that the product cannot overflow.
        along = np.unique(cells[:, axis], return_inverse=True)[1]
        ids = np.unique(ids * (int(along.max()) + 1) + along, return_inverse=True)[1]
    counts = np.bincount(ids)
    return np.column_stack([np.bincount(ids, weights=points_m[:, axis]) / counts for axis in range(3)])


def spread(points_m: FloatArray, most: int) -> FloatArray:
    """All points, or ``most`` of them, evenly taken."""
    if len(points_m) <= most:
        return points_m
    return points_m[np.linspace(0, len(points_m) - 1, most).astype(np.intp)]


def _neighbour_covariances(cloud: Cloud, centres_m: FloatArray) -> FloatArray:
    """Covariances (divisor n) of the points around each centre that has enough of them, shape (m, 3, 3)."""
    lists = cloud.tree.query_ball_point(centres_m, ENTROPY_RADIUS_M, return_sorted=False)
    covariances = [np.cov(cloud.points_m[near].T, bias=True) for near in lists if len(near) >= ENTROPY_NEIGHBOURS]
    return np.reshape(covariances, (-1, 3, 3)) + ENTROPY_FLOOR_M**2 * np.eye(3)


@lru_cache(maxsize=1)
def _reference_cloud(path: Path) -> Cloud:
    """The reference cloud, read once for all runs on one dataset: a process of the evaluation lives for one job."""
    return make_cloud(read_pcd(path, f"reference cloud {path.name}"))
