"""EuRoC ground truth: ``state_groundtruth_estimate0/data.csv``, ns and metres, quaternions with w first.

Format: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamhive.trajectory.model import Trajectory, find_problem
from slamhive.trajectory.table import parse_table, read_bounded

LAYOUT = "timestamp_ns, px, py, pz, qw, qx, qy, qz and further columns"


def read_euroc(path: Path) -> Trajectory:
    """Read the poses of the body; velocities and biases behind them are left out.

    Stamps are nanoseconds since 1970 and become seconds, exact to a quarter of a microsecond.

    Raises:
        NotFound: There is no such file.
        InvalidInput: It is not such a file; the message names file, line and value.
    """
    table = parse_table(read_bounded(path), str(path), 8, LAYOUT, more_columns=True)
    stamps_s, positions_m = table.values[:, 0] / 1e9, table.values[:, 1:4]
    quats_xyzw = np.roll(table.values[:, 4:8], -1, axis=1)
    problem = find_problem(stamps_s, positions_m, quats_xyzw)
    if problem is not None:
        raise table.error(problem.index, problem.found, problem.remedy)
    return Trajectory(stamps_s, positions_m, quats_xyzw)
