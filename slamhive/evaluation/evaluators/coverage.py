"""How much of the recording the estimate covers."""

from __future__ import annotations

from slamhive.evaluation.evaluators.base import Figures, Paired
from slamhive.trajectory.completeness import measure_completeness, measure_own_coverage


class Coverage:
    """Coverage and gaps, by the protocol's gap threshold and by the estimate's own spacing."""

    keys = ("tracked_fraction", "gap.max", "gap.count", "tracked.path", "tracked.time", "gap.own")

    def evaluate(self, paired: Paired) -> Figures:
        """Over the time span of the whole ground truth."""
        found = measure_completeness(
            paired.estimate.stamps_s, paired.reference.stamps_s, paired.protocol.gap_threshold_s
        )
        own = measure_own_coverage(paired.estimate.stamps_s, paired.reference, paired.protocol.gap_threshold_s)
        return Figures(
            {
                "tracked_fraction": found.tracked_fraction,
                "gap.max": found.longest_gap_s,
                "gap.count": float(found.gap_count),
                "tracked.path": own.path_share,
                "tracked.time": own.time_share,
                "gap.own": own.gap_s,
            }
        )
