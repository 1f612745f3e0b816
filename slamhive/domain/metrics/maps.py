"""Metrics of a map, ``Map.pcd``, against a reference cloud, or without one."""

from __future__ import annotations

from slamhive.domain.metrics.model import Direction, Group, Metric

MAP_THRESHOLDS_M = (0.05, 0.1, 0.2)
"""Distances within which a point counts as right."""
MAP_VOXEL_M = 0.02
"""Both clouds are thinned to one point, the mean, for each voxel of this size before they are compared."""
COMPARED_POINTS = 1_000_000
"""Distances are taken from at most so many points, evenly taken."""
ENTROPY_RADIUS_M = 0.3
"""Neighbourhood of a point whose spread the map entropy measures."""
ENTROPY_NEIGHBOURS = 10
"""Points with fewer neighbours have no entropy."""
ENTROPY_POINTS = 2000
"""The entropy is the mean over at most so many points, evenly taken."""
ENTROPY_FLOOR_M = 0.001
"""What is thinner than this counts as this thick: the entropy of a perfect plane would be minus infinity."""

_KNAPITSCH = "Knapitsch et al., Tanks and Temples, ACM Transactions on Graphics 36, 2017"
_DROESCHEL = "Droeschel and Behnke, Efficient Continuous-time SLAM for 3D Lidar-based Online Mapping, ICRA 2018"
_CLOUDS = f"map moved by the trajectory's alignment, both clouds thinned to one point per voxel of {MAP_VOXEL_M:g} m"


def _map(
    key: str, label: str, unit: str, definition: str, source: str = _KNAPITSCH, direction: Direction = Direction.LOWER
) -> Metric:
    return Metric(key, label, unit, direction, definition, True, Group.MAP, source)


def _within(threshold_m: float) -> list[Metric]:
    centimetres = f"{threshold_m * 100:g}cm"
    near = f"{threshold_m:g} m"
    higher = Direction.HIGHER
    return [
        _map(
            f"map.accuracy.{centimetres}",
            f"Map accuracy {near}",
            "",
            f"Share of the map's points with a reference point within {near}; {_CLOUDS}.",
            direction=higher,
        ),
        _map(
            f"map.completeness.{centimetres}",
            f"Map completeness {near}",
            "",
            f"Share of the reference's points with a map point within {near}; {_CLOUDS}.",
            direction=higher,
        ),
        _map(
            f"map.fscore.{centimetres}",
            f"Map F-score {near}",
            "",
            f"Harmonic mean of map accuracy and map completeness at {near}.",
            direction=higher,
        ),
    ]


MAP_METRICS = (
    *(metric for threshold_m in MAP_THRESHOLDS_M for metric in _within(threshold_m)),
    _map("map.accuracy.mean", "Map distance mean", "m", f"Mean distance from a map point to the reference; {_CLOUDS}."),
    _map(
        "map.completeness.mean",
        "Reference distance mean",
        "m",
        f"Mean distance from a reference point to the map; {_CLOUDS}.",
    ),
    _map(
        "map.chamfer",
        "Chamfer distance",
        "m",
        "Half the sum of the mean distances from map to reference and from reference to map.",
        "Fan et al., A Point Set Generation Network, CVPR 2017, with distances instead of squares",
    ),
    _map(
        "map.entropy",
        "Mean map entropy",
        "nats",
        f"Mean of 0.5 ln det(2 pi e C) over points of the map. C is the covariance of the points within "
        f"{ENTROPY_RADIUS_M:g} m, at least {ENTROPY_NEIGHBOURS}, plus ({ENTROPY_FLOOR_M:g} m)^2 on its diagonal. The "
        f"map is thinned to one point per voxel of {MAP_VOXEL_M:g} m. Lower is crisper. It needs no reference, and "
        "compares maps of one place only.",
        _DROESCHEL,
    ),
    _map(
        "map.points",
        "Map points",
        "",
        "Number of points in the map as the algorithm wrote it, those that are not finite left out.",
        "SLAM Hive",
        Direction.NEUTRAL,
    ),
)
