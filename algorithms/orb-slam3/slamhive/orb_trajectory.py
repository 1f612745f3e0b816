"""What ORB-SLAM3 writes as its trajectory, put right."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def without_repeats(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rows of ``table`` (n, 8: stamp, position, quaternion) without those whose stamp an earlier row has."""
    _, first = np.unique(table[:, 0], return_index=True)
    return table[np.sort(first)]
