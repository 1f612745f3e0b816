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
