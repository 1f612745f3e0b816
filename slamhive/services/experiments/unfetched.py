"""Sequences of the catalogue that an experiment names and that are not here yet: what a plan assumes, what to fetch."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from slamhive.domain.algorithm import ROS1_SUFFIX
from slamhive.domain.collection import Collection, RemoteFile, Sequence
from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.domain.names import plural
from slamhive.domain.sensors import CalibrationValue, Sensor, SensorKind

ASSUMED_DURATION_S = 120.0
"""The assumed duration of a recording that is not here, since the catalogue states none."""


_IMAGE: dict[str, CalibrationValue] = {
    "width": 752, "height": 480, "fx": 458.0, "fy": 457.0, "cx": 376.0, "cy": 240.0, "model": "pinhole",
}  # fmt: skip
_TYPICAL: dict[SensorKind, dict[str, CalibrationValue]] = {
    SensorKind.CAMERA: _IMAGE,
    SensorKind.DEPTH: _IMAGE,
    SensorKind.IMU: {
        "gyroscope_noise_density": 1.7e-4,
        "gyroscope_random_walk": 2e-5,
        "accelerometer_noise_density": 2e-3,
        "accelerometer_random_walk": 3e-3,
    },
    SensorKind.LIDAR: {
        "beams": 16, "lowest_angle_deg": -15.0, "highest_angle_deg": 15.0, "points_per_ring": 1800,
        "ring_distance_deg": 2.0, "rotation": "clockwise", "scan_duration_s": 0.1, "point_time_field": "t",
        "ring_field": "ring",
    },
}  # fmt: skip
"""What packages may ask of a sensor, with values that decide nothing in a plan."""


@dataclass(frozen=True, slots=True)
class Unfetched:
    """One sequence of the catalogue under the name of the dataset that it would become."""

    dataset: str
    collection: Collection
    sequence: Sequence


def unfetched(names: Iterable[str], here: Mapping[str, Dataset], project_root: Path) -> dict[str, Unfetched]:
    """Those of ``names`` that are no dataset here but would be one of a sequence in the catalogue."""
    missing = [name for name in names if name not in here]
    if not missing:
        return {}
    from slamhive.services.fetching import Collections  # noqa: PLC0415 - loads the downloads, for missing ones only

    offered = {
        sequence.dataset_name: Unfetched(sequence.dataset_name, collection, sequence)
        for collection in Collections(project_root).all
        for sequence in collection.sequences
    }
    return {name: offered[name] for name in missing if name in offered}


def assumed_dataset(entry: Unfetched, folder: Path) -> Dataset:
    """The dataset that a sequence would become, as far as the catalogue knows it.

    Its sensors have the calibration of a common one of their kind. Their rates are above every rate that a step may ask
    for, so the plan counts each step as a change. Nothing can be run on it.
    """
    sensors = tuple(
        Sensor(
            f"{kind.value}{place}", kind, f"/{kind.value}{place}", rate_hz=math.inf, calibration=_TYPICAL.get(kind, {})
        )
        for kind, count in entry.sequence.sensors.items()
        for place in range(count)
    )
    return Dataset(
        name=entry.dataset,
        folder=folder,
        bag=f"recording{ROS1_SUFFIX}",  # the one format that every package plays
        duration_s=ASSUMED_DURATION_S,
        sensors=sensors,
        groundtruth=GroundTruth("groundtruth.txt", gravity_aligned=True) if entry.sequence.groundtruth else None,
        checksum="",
        title=entry.collection.title,
    )


@dataclass(frozen=True, slots=True)
class ToFetch:
    """Sequences that an experiment needs from elsewhere.

    Attributes:
        datasets: The names of the datasets that are missing.
        sequences: What to fetch for each, ``COLLECTION/SEQUENCE``.
        download_bytes: Of all files together, each counted once; None if no size is known.
        unknown: Number of files whose size the catalogue does not know.
    """

    datasets: tuple[str, ...]
    sequences: tuple[str, ...]
    download_bytes: int | None
    unknown: int

    @property
    def command(self) -> str:
        """The command that fetches everything."""
        return f"slamhive dataset fetch {' '.join(self.sequences)}"

    @property
    def words(self) -> str:
        """The amount in a sentence: ``5 datasets are not here yet, about 12.7 GB to download``."""
        verb = "is" if len(self.datasets) == 1 else "are"
        text = f"{plural(len(self.datasets), 'dataset')} {verb} not here yet"
        if self.download_bytes is not None:
            text += f", about {self.download_bytes / 1e9:,.1f} GB to download"
        if self.unknown:
            text += (
                f", {'and ' if self.download_bytes is not None else ''}{plural(self.unknown, 'file')} of unknown size"
            )
        return text


def to_fetch(missing: Mapping[str, Unfetched]) -> ToFetch | None:
    """The sequences to fetch and their size; None if everything is here. Shared files count once."""
    if not missing:
        return None
    files: dict[tuple[str, ...], RemoteFile] = {
        part.file.addresses: part.file for entry in missing.values() for part in entry.sequence.parts
    }
    known = [size for file in files.values() if (size := file.estimate_bytes) is not None]
    return ToFetch(
        datasets=tuple(missing),
        sequences=tuple(entry.sequence.full_name for entry in missing.values()),
        download_bytes=sum(known) if known else None,
        unknown=len(files) - len(known),
    )
