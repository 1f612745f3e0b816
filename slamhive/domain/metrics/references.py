"""Metrics from more than two trajectories, or one: covariances of the algorithm, relations measured by people."""

from __future__ import annotations

from slamhive.domain.metrics.model import Direction, Group, Metric, statistics

_BAR_SHALOM = "Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 2001, section 5.4"
_KUEMMERLE = "Kuemmerle et al., On Measuring the Accuracy of SLAM Algorithms, Autonomous Robots 27, 2009"


def _nees(part: str, words: str) -> list[Metric]:
    return [
        Metric(
            f"nees.{part}",
            f"NEES {part}",
            "",
            Direction.NEUTRAL,
            f"Mean normalised estimation error squared e^T P^-1 e of the {words}. P is the covariance that the "
            "algorithm gave with the pose. 3 is consistent, more is overconfident, less too cautious.",
            True,
            Group.CONSISTENCY,
            _BAR_SHALOM,
        ),
        Metric(
            f"nees.{part}.within",
            f"NEES {part} within 95 %",
            "",
            Direction.NEUTRAL,
            f"Share of the poses whose {words} lies within the 95 % bound of its covariance (chi-square with 3 degrees "
            "of freedom: 7.81); 0.95 is consistent.",
            True,
            Group.CONSISTENCY,
            _BAR_SHALOM,
        ),
    ]


def _relations() -> list[Metric]:
    parts = {
        "translation": ("m", "distance between the positions that estimate and relation give to the second pose"),
        "rotation": ("deg", "angle between the orientations that estimate and relation give to the second pose"),
    }
    metrics: list[Metric] = []
    for part, (unit, what) in parts.items():
        definition = (
            f"the {what}, seen from the first. Each relation gives one value. Poses are those of the body frame. "
            "They are not aligned, but scaled under a protocol that leaves the scale open"
        )
        base = Metric(
            f"relations.{part}",
            f"Relations {part}",
            unit,
            Direction.LOWER,
            definition,
            True,
            Group.RELATIONS,
            _KUEMMERLE,
        )
        metrics += statistics(base, ("rmse", "mean", "std", "max"))
    metrics.append(
        Metric(
            "relations.translation.per_motion",
            "Relations translation per motion",
            "%",
            Direction.LOWER,
            "RMSE of the translation over the root mean square translation of the relations themselves, which is the "
            "RMSE of an estimate that never moves.",
            True,
            Group.RELATIONS,
            "SLAM Hive",
        )
    )
    metrics.append(
        Metric(
            "relations.matched_fraction",
            "Relations matched",
            "",
            Direction.HIGHER,
            "Share of the relations for which the estimate has a pose at both times. A pose may be interpolated "
            "between poses no further apart than the gap threshold.",
            True,
            Group.RELATIONS,
            "SLAM Hive",
        )
    )
    return metrics


REFERENCE_METRICS = (*_nees("position", "position error"), *_nees("orientation", "rotation error"), *_relations())


# Metrics of a map, ``Map.pcd``, against a reference cloud, or without one.


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
