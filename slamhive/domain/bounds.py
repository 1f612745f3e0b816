"""Promises of a package about its algorithms on one dataset, and the check of a run against them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from slamhive.domain.configuration import Playback
from slamhive.domain.parameters import Value
from slamhive.domain.protocol import ALIGNMENT_LABELS, Alignment
from slamhive.domain.verdict import ERROR, RELATION_ERROR, RELATION_ROTATION


@dataclass(frozen=True, slots=True)
class Bound:
    """One entry of ``bounds`` in ``algorithm.yaml``.

    Attributes:
        dataset: The name of the dataset.
        poses: The trajectory has at least so many poses.
        ate_rmse_m: The absolute trajectory error (RMSE, m) is at most this; None does not limit it.
        alignment: How the estimate is aligned before the error is computed.
        playback: How the recording is played. Sequential playback tests the algorithm, not the speed of the machine.
        parameters: Values that differ from the defaults.
        relations_m: The mean translation error (m) over the dataset's relations is at most this; None does not limit
            it. For datasets without ground truth.
        relations_deg: The same for the mean rotation error (degrees).
    """

    dataset: str
    poses: int
    ate_rmse_m: float | None
    alignment: Alignment
    playback: Playback
    parameters: Mapping[str, Value]
    relations_m: float | None = None
    relations_deg: float | None = None

    @property
    def words(self) -> str:
        """Describe the bounds: ``≥ 149 poses, ATE ≤ 0.03 m (SE(3))``."""
        parts = [f"≥ {self.poses} poses"]
        if self.ate_rmse_m is not None:
            parts.append(f"ATE ≤ {self.ate_rmse_m:g} m ({ALIGNMENT_LABELS[self.alignment]})")
        if self.relations_m is not None:
            parts.append(f"relations ≤ {self.relations_m:g} m")
        if self.relations_deg is not None:
            parts.append(f"≤ {self.relations_deg:g} deg")
        return ", ".join(parts)

    def broken_by(self, poses: int | None, metrics: Mapping[str, float]) -> str | None:
        """Why a run that succeeded and was evaluated does not keep the bound; None if it does."""
        if poses is None or poses < self.poses:
            return f"{poses or 0} poses, at least {self.poses} are needed"
        limits = (
            ("ATE RMSE", ERROR, self.ate_rmse_m, "m"),
            ("mean translation error of the relations", RELATION_ERROR, self.relations_m, "m"),
            ("mean rotation error of the relations", RELATION_ROTATION, self.relations_deg, "deg"),
        )
        for name, key, limit, unit in limits:
            error = metrics.get(key)
            if limit is None:
                continue
            if error is None:
                return "the trajectory could not be evaluated"
            if error > limit:
                return f"{name} {error:.4g} {unit}, at most {limit:g} {unit} is allowed"
        return None
