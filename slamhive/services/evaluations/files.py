"""The files that an evaluation may read besides the two trajectories."""

from __future__ import annotations

import stat
from pathlib import Path

from slamhive.domain.dataset import Dataset
from slamhive.evaluation.evaluators.base import (
    COVARIANCES,
    KITTI_ESTIMATE,
    KITTI_REFERENCE,
    MAP,
    REFERENCE_MAP,
    RELATIONS,
)
from slamhive.runs.folder import RunFolder


def evaluation_files(folder: RunFolder, dataset: Dataset) -> dict[str, Path]:
    """The files by the names that evaluators use; missing files and links are left out."""
    truth = dataset.groundtruth
    named = {
        COVARIANCES: folder.covariances,
        MAP: folder.map,
        RELATIONS: None if dataset.relations is None else dataset.folder / dataset.relations,
        REFERENCE_MAP: None if dataset.reference_map is None else dataset.folder / dataset.reference_map,
        KITTI_ESTIMATE: folder.kitti_poses,
        KITTI_REFERENCE: None if truth is None or truth.kitti_poses is None else dataset.folder / truth.kitti_poses,
    }
    return {name: path for name, path in named.items() if path is not None and _is_file(path)}


def _is_file(path: Path) -> bool:
    """Whether it is a regular file: an algorithm may have replaced it with a link."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except OSError:
        return False
