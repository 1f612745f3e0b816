"""How much of the recording the estimate covers."""

from __future__ import annotations

from slamhive.evaluation.evaluators.base import Figures, Paired
from slamhive.trajectory.completeness import measure_completeness


class Coverage:
    """Tracked fraction and gaps."""

    keys = ("tracked_fraction", "gap.max", "gap.count")

    def evaluate(self, paired: Paired) -> Figures:
        """Over the time span of the whole ground truth."""
        found = measure_completeness(
            paired.estimate.stamps_s, paired.reference.stamps_s, paired.protocol.gap_threshold_s
        )
        return Figures(
            {
                "tracked_fraction": found.tracked_fraction,
                "gap.max": found.longest_gap_s,
                "gap.count": float(found.gap_count),
            }
        )
