"""What a package promises of its algorithms on one dataset, and whether a run keeps it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from slamhive.domain.configuration import Playback
from slamhive.domain.parameters import Value
from slamhive.domain.protocol_choices import ALIGNMENT_LABELS, Alignment
from slamhive.domain.verdict import ERROR


@dataclass(frozen=True, slots=True)
class Bound:
    """One entry of ``bounds`` in ``algorithm.yaml``.

    Attributes:
        dataset: The name of the dataset.
        poses: The trajectory has at least so many poses.
        ate_rmse_m: The absolute trajectory error (RMSE, m) is at most this.
        alignment: How the estimate is aligned before the error is computed.
        playback: How the recording is played. Sequential playback tests the algorithm, not the speed of the machine.
        parameters: Values that differ from the defaults.
    """

    dataset: str
    poses: int
    ate_rmse_m: float
    alignment: Alignment
    playback: Playback
    parameters: Mapping[str, Value]

    @property
    def words(self) -> str:
        """As in ``≥ 149 poses, ATE ≤ 0.03 m (SE(3))``."""
        return f"≥ {self.poses} poses, ATE ≤ {self.ate_rmse_m:g} m ({ALIGNMENT_LABELS[self.alignment]})"

    def broken_by(self, poses: int | None, metrics: Mapping[str, float]) -> str | None:
        """Why a run that succeeded and was evaluated does not keep the bound; None if it does."""
        error_m = metrics.get(ERROR)
        if poses is None or poses < self.poses:
            return f"{poses or 0} poses, at least {self.poses} are needed"
        if error_m is None:
            return "the trajectory could not be evaluated"
        if error_m > self.ate_rmse_m:
            return f"ATE RMSE {error_m:.4g} m, at most {self.ate_rmse_m:g} m is allowed"
        return None
