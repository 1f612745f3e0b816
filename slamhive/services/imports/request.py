"""What an import is asked to do, and what it found and did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from slamhive.domain.protocol import Duplicates
from slamhive.domain.sensors import SensorSetup
from slamhive.trajectory.layout import UNKNOWN, Convention, QuaternionOrder, TimeUnit

DEFAULT_PATTERN = "<algorithm>/<dataset>/<trial>.txt"
DEFAULT_GROUND_TRUTH = "<dataset>/groundtruth.txt"
DEFAULT_TIMES = "<dataset>/times.txt"
DEFAULT_RELATIONS = "<dataset>/relations.txt"


class TrajectoryFormat(StrEnum):
    """How a trajectory is written; ``auto`` tells by the number of columns."""

    AUTO = "auto"
    TUM = "tum"
    KITTI = "kitti"
    EUROC = "euroc"


@dataclass(frozen=True, slots=True)
class ImportRequest:
    """Where trajectories lie and what cannot be read from them.

    Attributes:
        source: A folder, or with ``table`` a CSV file.
        table: Columns say what the pattern would: algorithm, dataset, trial, file.
        pattern: Of the trajectories below the folder.
        ground_truth: Pattern of the ground truths below the folder, for datasets that are not here yet.
        relations: Pattern of the files of relations, beside a ground truth or instead of one.
        times: Pattern of the stamps that KITTI poses lack.
        format: Of all trajectories.
        sensors: What each algorithm senses with; the key "" is for all others.
        gravity_aligned: The z axis of the ground truths points up.
        told: Time unit and quaternion order of the trajectories, as far as they shall not be detected.
        truth_told: Those of the ground truths.
        duplicates: What shall count where a timestamp occurs twice; the runs are evaluated so.
    """

    source: Path
    table: bool = False
    pattern: str = DEFAULT_PATTERN
    ground_truth: str = DEFAULT_GROUND_TRUTH
    relations: str = DEFAULT_RELATIONS
    times: str = DEFAULT_TIMES
    format: TrajectoryFormat = TrajectoryFormat.AUTO
    sensors: dict[str, SensorSetup] = field(default_factory=dict)
    gravity_aligned: bool = False
    told: Convention = UNKNOWN
    truth_told: Convention = UNKNOWN
    duplicates: Duplicates = Duplicates.REFUSE


@dataclass(frozen=True, slots=True)
class Candidate:
    """A file that may become a run; ``name`` is its path as the user sees it."""

    algorithm: str
    dataset: str
    trial: str
    path: Path
    name: str
    format: TrajectoryFormat
    times: Path | None = None
    told: Convention = UNKNOWN


@dataclass(frozen=True, slots=True)
class Problem:
    """What cannot be imported, and why, in one line."""

    name: str
    text: str


@dataclass
class Found:
    """What lies at the source.

    ``truths``, ``truth_told`` and ``relations`` by dataset, "" being for all; ``setups`` by algorithm; ``left_out``
    match no pattern.
    """

    candidates: list[Candidate] = field(default_factory=list)
    truths: dict[str, Path] = field(default_factory=dict)
    truth_told: dict[str, Convention] = field(default_factory=dict)
    relations: dict[str, Path] = field(default_factory=dict)
    setups: dict[str, SensorSetup] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Reading:
    """How the numbers of a file were taken, and what speaks for it.

    Attributes:
        name: Of the file, as the user sees it.
        time_unit: Of its timestamps.
        quaternion_order: Of its orientations; None where it has none, or matrices.
        because: {"time_unit" or "quaternion_order": why}.
        as_it_stands: It is a TUM file that was taken over byte for byte.
    """

    name: str
    time_unit: TimeUnit
    quaternion_order: QuaternionOrder | None
    because: Mapping[str, str]
    as_it_stands: bool

    @property
    def words(self) -> str:
        """``read as ns, xyzw``, as messages put it."""
        order = "" if self.quaternion_order is None else f", quaternions {self.quaternion_order}"
        return f"read with timestamps in {self.time_unit}{order}"


@dataclass
class ImportReport:
    """What was done, or with ``dry_run`` what would be.

    Attributes:
        run_ids: Of all runs that the source stands for: new ones and those imported before.
        imported: How many are new.
        known: How many had been imported before.
        datasets: Datasets that were made of ground truths or relations.
        readings: How the files were read, ground truths too.
        problems: What was not imported.
        left_out: Files that match no pattern.
    """

    dry_run: bool
    run_ids: list[int] = field(default_factory=list)
    imported: int = 0
    known: int = 0
    datasets: list[str] = field(default_factory=list)
    readings: list[Reading] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
