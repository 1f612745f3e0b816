"""Request, found files and report of an import, and the lock that lets one import at a time file runs."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.errors import Conflict, Unavailable
from slamhive.base.files import remedy_of, sweep_folder
from slamhive.domain.protocol import Duplicates, TrajectoryKind
from slamhive.domain.sensors import SensorSetup
from slamhive.recordings.variants.cache import Busy, exclusive
from slamhive.trajectory.layout import UNKNOWN, Convention, QuaternionOrder, TimeUnit
from slamhive.trajectory.pose_file import TrajectoryFormat

logger = logging.getLogger(__name__)

DEFAULT_PATTERN = "<algorithm>/<dataset>/<trial>.txt"
DEFAULT_GROUND_TRUTH = "<dataset>/groundtruth.txt"
DEFAULT_TIMES = "<dataset>/times.txt"
DEFAULT_RELATIONS = "<dataset>/relations.txt"
DEFAULT_IMAGE_TIMES = "<dataset>/rgb.txt"


@dataclass(frozen=True, slots=True)
class ImportRequest:
    """Where the trajectories are, and the facts that cannot be read from them.

    Attributes:
        source: A folder, or with ``table`` a CSV file.
        table: The columns replace the pattern: algorithm, dataset, trial, file.
        pattern: Of the trajectories below the folder.
        ground_truth: Pattern of the ground truths below the folder, for datasets that are not here yet.
        relations: Pattern of the files of relations, beside a ground truth or instead of one.
        times: Pattern of the timestamp files for KITTI poses.
        image_times: Pattern of the files that say when images were taken, such as ``rgb.txt``.
        format: Of all trajectories.
        sensors: The sensor setup of each algorithm; the key "" is for all others.
        gravity_aligned: The z axis of the ground truths points up.
        told: Time unit and quaternion order of the trajectories, unless they are to be detected.
        truth_told: The same for the ground truths.
        duplicates: Which pose counts if a timestamp occurs twice, in the evaluation of the runs.
        trajectory: Which trajectory the files are, None if it is not stated.
        columns: What the columns of the trajectories hold; None to find out.
    """

    source: Path
    table: bool = False
    pattern: str = DEFAULT_PATTERN
    ground_truth: str = DEFAULT_GROUND_TRUTH
    relations: str = DEFAULT_RELATIONS
    times: str = DEFAULT_TIMES
    image_times: str = DEFAULT_IMAGE_TIMES
    format: TrajectoryFormat = TrajectoryFormat.AUTO
    sensors: dict[str, SensorSetup] = field(default_factory=dict)
    gravity_aligned: bool = False
    told: Convention = UNKNOWN
    truth_told: Convention = UNKNOWN
    duplicates: Duplicates = Duplicates.REFUSE
    trajectory: TrajectoryKind | None = None
    columns: str | None = None


@dataclass(frozen=True, slots=True)
class ImportCandidate:
    """A file that may become a run; ``name`` is its path as the user sees it."""

    algorithm: str
    dataset: str
    trial: str
    path: Path
    name: str
    format: TrajectoryFormat
    times: Path | None = None
    told: Convention = UNKNOWN
    columns: str | None = None


@dataclass(frozen=True, slots=True)
class ImportProblem:
    """A file that cannot be imported, and why, in one line."""

    name: str
    text: str


@dataclass
class FoundImports:
    """The files at the source.

    ``truths``, ``truth_told``, ``relations`` and ``image_times`` by dataset, "" being for all; ``setups`` by algorithm;
    ``left_out`` match no pattern.
    """

    candidates: list[ImportCandidate] = field(default_factory=list)
    truths: dict[str, Path] = field(default_factory=dict)
    truth_told: dict[str, Convention] = field(default_factory=dict)
    relations: dict[str, Path] = field(default_factory=dict)
    image_times: dict[str, Path] = field(default_factory=dict)
    setups: dict[str, SensorSetup] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    problems: list[ImportProblem] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Reading:
    """The conventions of a file, and the evidence for them.

    Attributes:
        name: The name of the file, as the user sees it.
        time_unit: Of its timestamps.
        quaternion_order: Of its orientations; None if it has none, or matrices.
        because: {"time_unit" or "quaternion_order": why}; "orientation" says why there is none.
        as_it_stands: It is a TUM file that was copied byte for byte.
    """

    name: str
    time_unit: TimeUnit
    quaternion_order: QuaternionOrder | None
    because: Mapping[str, str]
    as_it_stands: bool

    @property
    def words(self) -> str:
        """For messages: ``read as ns, xyzw``."""
        order = "" if self.quaternion_order is None else f", quaternions {self.quaternion_order}"
        return f"read with timestamps in {self.time_unit}{order}"


@dataclass
class ImportReport:
    """Result of an import, or with ``dry_run`` of its rehearsal.

    Attributes:
        run_ids: The runs of all files, new ones and those imported before.
        imported: Number of new runs.
        known: Number of runs imported before.
        datasets: Datasets created from ground truths or relations.
        readings: The conventions of the files, ground truths included.
        problems: Files that were not imported.
        left_out: Files that match no pattern.
    """

    dry_run: bool
    run_ids: list[int] = field(default_factory=list)
    imported: int = 0
    known: int = 0
    datasets: list[str] = field(default_factory=list)
    readings: list[Reading] = field(default_factory=list)
    problems: list[ImportProblem] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


# The lock: one import files runs at a time, be they single or of an archive.

ASIDE = ".import-"
"""How the names of folders begin in which imported runs are put together."""
UNPACKED = ".archive"
"""How the names of folders begin for what is unpacked from an archive; their import holds them."""
WAIT_S = 10.0
"""Longest that an import waits for its turn to file runs."""
_LOCK = ".import.lock"

Waiting = Callable[[str], None]
"""Called with what an import waits for, in words."""


@contextmanager
def one_import(runs: Path, what: str, waiting: Waiting = lambda _text: None) -> Iterator[None]:
    """Lock the runs folder against other imports and remove what killed ones have left.

    An import takes the lock for each batch that it files, so that a small one gets its turn between the batches of a
    large one. Reading, checking and unpacking need no lock.

    Args:
        runs: The folder of runs.
        what: What is imported, for the messages of others who wait for it; neither a name nor a token of somebody.
        waiting: Called while another import files runs.

    Raises Conflict, saying what files runs and since when.
    """
    lock, began_s = runs / _LOCK, monotonic_s()

    def wait(_share: float, _text: str) -> None:
        try:
            content = json.loads(lock.read_text(encoding="utf-8"))
            since = datetime.fromisoformat(content["since"])
            text = f"another import files {content['what']} since {since:%H:%M:%S} UTC"
        except (OSError, ValueError, KeyError, TypeError):  # it begins or ends now, or an earlier version made it
            text = "another import files runs"
        if monotonic_s() - began_s >= WAIT_S:
            raise Conflict(text, "wait for it to end")
        waiting(f"waiting: {text}")

    with exclusive(lock, wait):
        try:
            lock.write_text(json.dumps({"what": what, "since": utc_now().isoformat()}), encoding="utf-8")
        except OSError as error:
            raise Unavailable(f"{lock} cannot be written: {error.strerror}", remedy_of(error)) from None
        _remove_leftovers(runs)
        try:
            yield
        finally:
            _remove_leftovers(runs)
            lock.unlink(missing_ok=True)


def sweep_imports(runs: Path) -> None:
    """Remove what killed imports have left, unless an import is under way."""
    if not list(_leftovers(runs)):
        return
    try:
        with exclusive(runs / _LOCK):
            _remove_leftovers(runs)
    except Busy:
        logger.info("an import is under way: leftovers of killed imports stay until the next sweep")


def _leftovers(runs: Path) -> Iterator[Path]:
    yield from runs.glob(f"{ASIDE}*")
    yield from runs.glob(f"{UNPACKED}*")


def _remove_leftovers(runs: Path) -> None:
    for path in list(_leftovers(runs)):
        sweep_folder(path)
