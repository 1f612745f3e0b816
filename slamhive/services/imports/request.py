"""What an import is asked to do, and what it found and did."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from slamhive.domain.sensors import SensorSetup

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


@dataclass(frozen=True, slots=True)
class Problem:
    """What cannot be imported, and why, in one line."""

    name: str
    text: str


@dataclass
class Found:
    """What lies at the source.

    ``truths`` and ``relations`` by dataset, "" being for all; ``setups`` by algorithm; ``left_out`` match no pattern.
    """

    candidates: list[Candidate] = field(default_factory=list)
    truths: dict[str, Path] = field(default_factory=dict)
    relations: dict[str, Path] = field(default_factory=dict)
    setups: dict[str, SensorSetup] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)


@dataclass
class ImportReport:
    """What was done, or with ``dry_run`` what would be.

    Attributes:
        run_ids: Of all runs that the source stands for: new ones and those imported before.
        imported: How many are new.
        known: How many had been imported before.
        datasets: Datasets that were made of ground truths or relations.
        problems: What was not imported.
        left_out: Files that match no pattern.
    """

    dry_run: bool
    run_ids: list[int] = field(default_factory=list)
    imported: int = 0
    known: int = 0
    datasets: list[str] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
