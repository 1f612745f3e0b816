"""All recorded runs in every unit and order, without headers: understood or asked for, never taken wrongly."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.services.imports.reading import ImportTruth, Partner, settle, settle_truth
from slamhive.trajectory.layout import UNKNOWN, QuaternionOrder, RawPoses, TimeUnit, read_tum
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.pose_file import PoseFile, TrajectoryFormat
from slamhive.trajectory.table import NumberTable

RUNS = project_root().parent / "shared" / "data" / "euroc_vio_runs"
S, XYZW, WXYZ = TimeUnit.S, QuaternionOrder.XYZW, QuaternionOrder.WXYZ

pytestmark = [
    pytest.mark.integration,
    pytest.mark.shared_data,
    pytest.mark.skipif(not RUNS.is_dir(), reason="the recorded runs are not in ../shared/data/euroc_vio_runs"),
]


def as_file(poses: Trajectory, unit: TimeUnit, order: QuaternionOrder, zero_s: float) -> PoseFile:
    """The poses as eight columns in that unit and order, counted from ``zero_s``."""
    quats = poses.quats_xyzw if order is XYZW else np.roll(poses.quats_xyzw, 1, axis=1)
    table = NumberTable("run.txt", np.empty((0, 8)), b"")
    return PoseFile(
        b"",
        TrajectoryFormat.TUM,
        RawPoses(table, (poses.stamps_s - zero_s) * unit.per_second, poses.positions_m, quats),
    )


def counted_from(poses: Trajectory, zero_s: float) -> Trajectory:
    return Trajectory(poses.stamps_s - zero_s, poses.positions_m, poses.quats_xyzw)


@pytest.mark.parametrize("sequence", sorted(path.name for path in RUNS.glob("[MV]*")))
def test_every_run_is_understood_in_every_unit_and_order(sequence: str) -> None:
    truth = read_tum(RUNS / sequence / "groundtruth.txt")
    for path in sorted(RUNS.glob(f"v*/{sequence}/*.txt")):
        estimate = read_tum(path)
        for zero_s in (0.0, float(truth.stamps_s[0])):
            known = ImportTruth(counted_from(truth, zero_s), rotations_known=True)
            for unit, order in ((unit, order) for unit in TimeUnit for order in QuaternionOrder):
                file = as_file(estimate, unit, order, zero_s)
                if (unit, order) == (S, WXYZ):  # it looks like a TUM file and turns otherwise
                    with pytest.raises(InvalidInput, match="quaternion order is in doubt: xyzw as in TUM files, but"):
                        settle(file, "run", UNKNOWN, known)
                else:
                    found = settle(file, "run", UNKNOWN, known)
                    assert (found.time_unit, found.quaternion_order) == (unit, order), (path, zero_s)


def truths() -> list[tuple[Path, Path]]:
    return [(path.parent, next(RUNS.glob(f"v*/{path.parent.name}/0.txt"))) for path in RUNS.glob("*/groundtruth.txt")]


def test_a_ground_truth_is_understood_by_an_estimate_or_asked_for() -> None:
    understood = 0
    for folder, path in truths():
        truth, estimate = read_tum(folder / "groundtruth.txt"), read_tum(path)
        for zero_s in (0.0, float(truth.stamps_s[0])):
            partner = Partner(as_file(estimate, S, XYZW, zero_s), UNKNOWN)
            for unit, order in ((unit, order) for unit in TimeUnit for order in QuaternionOrder):
                with suppress(InvalidInput):
                    found = settle_truth(as_file(truth, unit, order, zero_s), "truth", UNKNOWN, [partner])
                    assert (found.time_unit, found.quaternion_order) == (unit, order), (folder, zero_s)
                    understood += 1
    assert understood >= 0.8 * 11 * 14, "seven of the eight combinations, with dates and counted from zero"
