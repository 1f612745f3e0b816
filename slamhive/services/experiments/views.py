"""Values that the experiment service takes and returns, and that command line, pages and JSON show."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from slamhive.base import strict_yaml
from slamhive.documents.plain import ToFetchDocument
from slamhive.domain.algorithm import ROS1_SUFFIX
from slamhive.domain.collection import Collection, RemoteFile, Sequence
from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.domain.parameters import Value
from slamhive.domain.sensors import CalibrationValue, Sensor, SensorKind
from slamhive.domain.verdict import Failure, Outcome
from slamhive.store.records import CellRun, ProtocolLabel

MOST_LISTED = 200
"""A grid cell lists at most this many configurations: a longer URL is too long for some servers."""


@dataclass(frozen=True, slots=True)
class ExperimentSource:
    """The text of an experiment file, and its name in messages."""

    text: str
    name: str = "experiment.yaml"

    @classmethod
    def read(cls, path: Path) -> ExperimentSource:
        """The file at ``path``; raises InvalidInput."""
        return cls(strict_yaml.read_text(path), str(path))


@dataclass(frozen=True, slots=True)
class MetricSpread:
    """Mean, median and sample standard deviation of ``n`` values; a single value has no deviation."""

    n: int
    mean: float
    median: float
    std: float | None


@dataclass(frozen=True, slots=True)
class CellFigures:
    """Metrics of the successful runs of a cell under one protocol (fingerprint; None if not evaluated).

    ``disturbed`` of these runs were measured on a disturbed machine.
    """

    protocol: str | None
    runs: int
    disturbed: int
    metrics: Mapping[str, MetricSpread]


@dataclass(frozen=True, slots=True)
class Cell:
    """One configuration of an experiment with its runs.

    ``counts`` as in ``ExperimentStatusDocument``; ``failures`` counts all failed runs, retried ones too. Metrics of
    different protocols are kept apart.
    """

    number: int
    name: str
    configuration_id: int
    values: Mapping[str, Value]
    runs: tuple[CellRun, ...]
    counts: Mapping[Outcome, int]
    failures: Mapping[Failure, int]
    figures: tuple[CellFigures, ...]


@dataclass(frozen=True, slots=True)
class CellPage:
    """One page of cells, in order. ``next_number`` is the key of the next page, None on the last."""

    cells: tuple[Cell, ...]
    total: int
    next_number: int | None


@dataclass(frozen=True, slots=True)
class GridCell:
    """The cells of an experiment with the same two axis values: their number, the first one, and runs by phase.

    ``configurations`` are their numbers, empty if there are more than :data:`MOST_LISTED`. ``counts`` and
    ``failures`` (runs by reason) as in ``ExperimentStatusDocument``.
    """

    cells: int
    first: int
    configurations: tuple[int, ...]
    counts: Mapping[Outcome, int]
    failures: Mapping[Failure, int]


@dataclass(frozen=True, slots=True)
class MetricGrid:
    """Means of a metric over two axes, in the unit of the catalogue.

    ``cells``: {(row, column) as in :class:`ExperimentGrid`: mean, deviation and number of the good runs}. Runs count
    under ``protocol``, that of most good runs; ``other_runs`` have another one and are left out. ``protocol`` is None
    without a value.
    """

    protocol: ProtocolLabel | None
    other_runs: int
    cells: Mapping[tuple[int, int], MeanOfRuns] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class MeanOfRuns:
    """Mean and sample standard deviation of ``n`` runs; a single one has no deviation."""

    n: int
    mean: float
    std: float | None


@dataclass(frozen=True, slots=True)
class ExperimentGrid:
    """Progress over two axes. A value is None if the axis does not apply (``features`` for a LiDAR algorithm).

    ``cells``: {(row, column) as indices of ``rows`` and ``columns``: cell}, without combinations that do not exist.
    """

    row_axis: str
    column_axis: str
    rows: tuple[Value | None, ...]
    columns: tuple[Value | None, ...]
    cells: Mapping[tuple[int, int], GridCell] = field(default_factory=dict)


# -- sequences of the catalogue that an experiment names and that are not here yet: what a plan assumes, what to fetch


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


def to_fetch(missing: Mapping[str, Unfetched]) -> ToFetchDocument | None:
    """The sequences to fetch and their size; None if everything is here. Shared files count once."""
    if not missing:
        return None
    files: dict[tuple[str, ...], RemoteFile] = {
        part.file.addresses: part.file for entry in missing.values() for part in entry.sequence.parts
    }
    known = [size for file in files.values() if (size := file.estimate_bytes) is not None]
    sequences = tuple(entry.sequence.full_name for entry in missing.values())
    return ToFetchDocument(
        datasets=tuple(missing),
        sequences=sequences,
        download_bytes=sum(known) if known else None,
        unknown=len(files) - len(known),
        command=f"slamhive dataset fetch {' '.join(sequences)}",
    )
