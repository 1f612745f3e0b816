"""What was done to the estimate before errors were taken: its scale, and the offset of its clock."""

from __future__ import annotations

from slamhive.evaluation.evaluators.base import Figures, Paired


class AppliedAlignment:
    """Scale and time offset that were applied."""

    keys = ("alignment.scale", "alignment.time_offset")

    def evaluate(self, paired: Paired) -> Figures:
        """Both are always known."""
        return Figures({"alignment.scale": paired.transform.scale, "alignment.time_offset": paired.time_offset_s})
