"""Trajectories of runs, for NumPy, pandas and evo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from slamhive.domain.protocol import Duplicates
from slamhive.trajectory.layout import parse_tum
from slamhive.trajectory.model import Trajectory

if TYPE_CHECKING:
    from evo.core.trajectory import PoseTrajectory3D


@dataclass(frozen=True, slots=True, eq=False)
class RunTrajectory(Trajectory):
    """Timestamped poses: ``stamps_s`` (n,), ``positions_m`` (n, 3), ``quats_xyzw`` (n, 4)."""

    @classmethod
    def of_tum(cls, data: bytes, name: str) -> RunTrajectory:
        """The trajectory in a TUM file that messages call ``name``; raises InvalidInput. Equal timestamps stay."""
        found = parse_tum(data, name, Duplicates.KEEP)
        return cls(found.stamps_s, found.positions_m, found.quats_xyzw)

    def to_evo(self) -> PoseTrajectory3D:
        """The same as a trajectory of evo."""
        from evo.core.trajectory import PoseTrajectory3D  # noqa: PLC0415 - takes a second to load

        quats_wxyz = self.quats_xyzw[:, [3, 0, 1, 2]]
        return PoseTrajectory3D(self.positions_m.copy(), quats_wxyz, self.stamps_s.copy())

    def to_pandas(self) -> Any:
        """A data frame with the columns of the TUM format, times in s and positions in m."""
        import pandas as pd  # noqa: PLC0415 - takes half a second to load

        columns = {"timestamp": self.stamps_s}
        columns |= {f"t{axis}": self.positions_m[:, place] for place, axis in enumerate("xyz")}
        columns |= {f"q{axis}": self.quats_xyzw[:, place] for place, axis in enumerate("xyzw")}
        return pd.DataFrame(columns)
