"""The ground truth of a dataset as other formats write it: times in ns, poses of the sensor they ask for."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal

import numpy as np

from slamhive.bags.geometry import Array, quaternions_from_rotations
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import IDENTITY4, Matrix4
from slamhive.trajectory.transforms import rotations_from_quats
from slamhive.trajectory.tum import read_tum

_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, eq=False)
class Truth:
    """Poses in the world: times (n,) int64 ns, positions (n, 3), unit quaternions (n, 4) x y z w."""

    times_ns: Array
    positions_m: Array
    quats_xyzw: Array

    def of_sensor(self, T_body_sensor: Matrix4) -> Truth:
        """The poses of a sensor, where these are the body's."""
        if T_body_sensor == IDENTITY4:
            return self
        T = np.array(T_body_sensor).reshape(4, 4)
        R = rotations_from_quats(self.quats_xyzw)
        positions_m = self.positions_m + R @ T[:3, 3]
        return Truth(self.times_ns, positions_m, quaternions_from_rotations(R @ T[:3, :3]))


def read_truth(dataset: Dataset) -> Truth | None:
    """The full poses of ``dataset``; None if it has no ground truth, or positions only.

    Times are read as decimal numbers: a double has no room for nanoseconds of our century.
    """
    truth, path = dataset.groundtruth, dataset.groundtruth_path
    if truth is None or path is None or truth.positions_only:
        return None
    poses = read_tum(path)
    lines = (line.split() for line in path.read_text(encoding="utf-8").replace(",", " ").splitlines())
    words = [line[0] for line in lines if line and not line[0].startswith("#")]
    times_ns = np.array([round(Decimal(word) * _NS_PER_S) for word in words], dtype=np.int64)
    return Truth(times_ns, poses.positions_m, poses.quats_xyzw)


def truth_left_out(dataset: Dataset) -> tuple[str, ...]:
    """The ground truth, in words, if it has positions only: formats of poses cannot hold it."""
    truth = dataset.groundtruth
    return ("the ground truth (positions only)",) if truth is not None and truth.positions_only else ()
