"""The absolute error relative to the travelled path, which separates drift from divergence."""

from __future__ import annotations

import numpy as np

from slamhive.evaluation.evaluators.base import Figures, Paired


class RelativeSize:
    """ATE RMSE in percent of the true path, and of the error of an estimate that never moves."""

    keys = ("ate.per_path", "ate.per_extent")

    def evaluate(self, paired: Paired) -> Figures:
        """Missing where the ground truth does not move.

        The path alone does not tell divergence in a room: under Sim(3) the error never exceeds the extent, which is a
        few percent of a long path within four walls. The extent alone does not tell it on a road.
        """
        truth = paired.matched_reference.positions_m
        error_m = _rms(paired.aligned.positions_m - truth)
        stamps_s = paired.matched_reference.stamps_s
        covered = (paired.reference.stamps_s >= stamps_s[0]) & (paired.reference.stamps_s <= stamps_s[-1])
        path_m = paired.reference.take(np.flatnonzero(covered)).path_length_m
        sizes_m = {"ate.per_path": path_m, "ate.per_extent": _rms(truth - truth.mean(axis=0))}
        values = {key: 100.0 * error_m / size_m for key, size_m in sizes_m.items() if size_m > 0}
        missing = {key: "the ground truth does not move" for key in self.keys if key not in values}
        return Figures(values, missing)


def _rms(vectors_m: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors_m**2, axis=1))))
