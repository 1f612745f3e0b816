"""A dataset with a real recording, small enough to treat in milliseconds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from slamhive.domain.dataset import Dataset
from slamhive.packages.dataset_file import dataset_to_yaml
from slamhive.recordings.room.sensors import POINT_TYPE
from slamhive.recordings.staging import checksum
from slamhive.recordings.writers import BagWriter
from tests.services.tiny_project import make_dataset

SCANS = 20
POINTS = 200


def make_recorded_track(data: Path, name: str = "track") -> Dataset:
    """The dataset of :func:`make_dataset` with a bag of ``SCANS`` scans at 10 Hz."""
    dataset = make_dataset(data, name)
    dataset.bag_path.unlink()
    points = np.zeros(POINTS, dtype=POINT_TYPE)
    points["x"] = np.linspace(1, 40, POINTS)
    with BagWriter(dataset.bag_path) as bag:
        for number in range(SCANS):
            stamp_ns = 100_000_000_000 + number * 100_000_000
            bag.points(dataset.sensors[0], stamp_ns, stamp_ns, points)
    described = replace(dataset, duration_s=1.9, checksum=checksum(dataset.bag_path))
    (dataset.folder / "dataset.yaml").write_text(dataset_to_yaml(described))
    return described
