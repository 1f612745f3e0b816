"""How challenges of the field count: protocol, metric, and the rule that makes one score of many sequences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from slamhive.domain.challenge import Format, Rule

MEAN, ETH3D, KITTI, HILTI_2026 = "mean", "eth3d", "kitti", "hilti-2026"
WEIGHT = "kitti.segments"
"""The metric that says how much a sequence weighs in a pooled score."""


@dataclass(frozen=True, slots=True)
class ChallengePreset:
    """One way to count.

    Attributes:
        protocol: Name of the protocol; None if the challenge names it.
        metric: Key of the metric of a sequence; None if the challenge names it.
        worst: The value of a failed sequence, unless the challenge says another; None if there is none by default.
        words: How it counts, for pages.
    """

    protocol: str | None
    metric: str | None
    rule: Rule
    worst: float | None
    format: Format
    words: str


PRESETS: Mapping[str, ChallengePreset] = {
    MEAN: ChallengePreset(None, None, Rule.MEAN, None, Format.TUM, "The mean over all sequences."),
    ETH3D: ChallengePreset(
        "eth3d",
        "ate.rmse",
        Rule.AREA,
        0.10,
        Format.TUM,
        "The area under the curve of how many sequences are better than x, as a percentage of the largest area.",
    ),
    KITTI: ChallengePreset(
        "kitti",
        "kitti.translation",
        Rule.POOLED,
        None,
        Format.KITTI,
        "The mean translation error over the segments of all sequences. Every frame of every sequence is needed.",
    ),
    HILTI_2026: ChallengePreset(
        "hilti-2026",
        "hilti.score",
        Rule.MEAN,
        0.0,
        Format.TUM,
        "The mean score over all sequences: 100 for each pose without an error, 1 for one that is off by 10 m.",
    ),
}
