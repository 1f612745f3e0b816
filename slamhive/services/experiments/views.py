"""Values that the experiment service takes and returns, and that command line, pages and JSON show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from pathlib import Path

from slamhive.base import strict_yaml
from slamhive.domain.accounts import Visibility
from slamhive.domain.configuration import Variant
from slamhive.domain.outcome import Failure, Outcome
from slamhive.domain.parameters import Value
from slamhive.domain.placement import Remaining
from slamhive.domain.protocol import Alignment
from slamhive.domain.question import ExperimentQuestion
from slamhive.domain.run import FailureReason
from slamhive.domain.side_by_side import MixedProtocols
from slamhive.services.experiments.unfetched import ToFetch
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


class ConfigurationStanding(StrEnum):
    """The state of an experiment. ``storing``: its start is under way or was interrupted."""

    STORING = "storing"
    ACTIVE = "active"
    PAUSED = "paused"
    CANCELLED = "cancelled"
    FINISHED = "finished"


@dataclass(frozen=True, slots=True)
class PreviewRow:
    """One of the first cells. ``known``: how many runs its configuration already has, queued ones included."""

    number: int
    name: str
    values: Mapping[str, Value]
    known: bool
    known_runs: int


@dataclass(frozen=True, slots=True)
class VariantNeed:
    """A variant of a dataset that runs need.

    ``made``: it is in the cache. Otherwise it needs at most ``needed_bytes`` and takes about ``make_s`` to make.
    """

    dataset: str
    variant: Variant
    key: str
    needed_bytes: int
    make_s: float
    made: bool


@dataclass(frozen=True, slots=True)
class NodesPlan:
    """The runs of an experiment on the nodes of a cluster, one at a time on each.

    ``used_nodes`` of ``nodes`` have something to do. ``time_s`` is for runs and their data. Each node gets the data of
    its runs once, at ``bytes_per_s``: ``moved_bytes`` in all, at most ``node_bytes`` on one node.
    """

    nodes: int
    used_nodes: int
    time_s: float
    moved_bytes: int
    node_bytes: int
    bytes_per_s: float


@dataclass(frozen=True, slots=True)
class PlannedMixture:
    """Planned runs whose errors would not be comparable; ``alignment`` would make them so, None if none is known."""

    protocols: MixedProtocols
    alignment: Alignment | None

    @property
    def sentences(self) -> str:
        """The counts and the way out in one line."""
        if self.alignment is None:
            return f"{self.protocols.words} Choose one alignment: evaluate: {{alignment: ...}}."
        option = f"evaluate: {{alignment: {self.alignment}}}"
        return f"{self.protocols.words} To evaluate all under {self.protocols.common_name}, add to the file: {option}"


@dataclass(frozen=True, slots=True)
class ExperimentPreview:
    """A preview of an experiment that has not been started.

    ``combinations`` counts them before conditions; ``cells`` counts the distinct configurations that remain
    (``merged`` were identical to another); ``runs`` includes seeds and repeats. ``known_cells`` configurations are
    stored already, with ``known_runs`` runs. ``time_s`` is the estimated time of builds, variants, runs and evaluations
    on the slots of this machine, or on ``cluster``. For ``measured_runs`` of them it uses the time of earlier runs; the
    others are assumed to last as long as a start and their recording. ``variant_time_s`` is the share of ``time_s`` for
    making variants, each once, ``build_time_s`` that for building packages. ``between_s`` is added to each run: what
    the worker does before and after it, and its evaluation.
    ``run_bytes`` estimates the size of the run folders from earlier ones. ``refusals`` are the reasons why the
    experiment cannot start. ``standing`` is that of the experiment if it is stored already. ``repeat_disturbed`` is
    how often each run is repeated at most because of a disturbed machine; the other numbers leave that out. ``mixed``
    is there if the runs would be evaluated under several protocols.
    """

    name: str
    description: str
    combinations: int
    cells: int
    merged: int
    runs: int
    axes: Mapping[str, int]
    rows: tuple[PreviewRow, ...]
    known_cells: int
    known_runs: int
    time_s: float
    variant_time_s: float
    measured_runs: int
    slots: int
    variants: tuple[VariantNeed, ...]
    variant_bytes: int
    run_bytes: int
    free_bytes: int
    warnings: tuple[str, ...]
    refusals: tuple[str, ...]
    standing: ConfigurationStanding | None
    repeat_disturbed: int = 0
    build_time_s: float = 0.0
    between_s: float = 0.0
    cluster: NodesPlan | None = None
    to_fetch: ToFetch | None = None
    mixed: PlannedMixture | None = None

    @property
    def mixed_protocols(self) -> str | None:
        """The mixture in one line, for JSON."""
        return None if self.mixed is None else self.mixed.sentences


@dataclass(frozen=True, slots=True)
class ExperimentStatus:
    """The progress of an experiment.

    ``counts`` of runs by phase leave out failed and disturbed runs that were repeated (``retried``). ``disturbed``
    of the counted runs were measured on a disturbed machine.
    ``failures``: {reason: runs}. ``left`` is the estimated time left with builds and evaluations, None if it was not
    asked for; ``phase`` says what happens now. ``missing`` runs are not stored, because the start was interrupted.
    With ``same_cpu`` all runs are measured on ``cpu_model``, which is None while it is not known.
    ``owner``: the account that it belongs to, None for nobody; ``visibility``: who may see it besides admins.
    One with a ``question`` chooses its runs until it has a ``conclusion``, a sentence.
    """

    id: int
    name: str
    description: str
    standing: ConfigurationStanding
    executor: str
    priority: int
    repeats: int
    created_at: datetime
    cells: int
    runs: int
    missing: int
    counts: Mapping[Outcome, int]
    retried: int
    failures: Mapping[Failure, int]
    disturbed: int
    left: Remaining | None
    phase: str = ""
    same_cpu: bool = False
    cpu_model: str | None = None
    owner: str | None = None
    visibility: Visibility = Visibility.TEAM
    question: ExperimentQuestion | None = None
    conclusion: str | None = None

    @property
    def left_s(self) -> float | None:
        """The expected time left."""
        return None if self.left is None else self.left.seconds

    @property
    def low_s(self) -> float | None:
        """The lower end of its interval; None if nothing was measured."""
        return None if self.left is None else self.left.low_s

    @property
    def high_s(self) -> float | None:
        """The upper end of its interval; None if nothing was measured."""
        return None if self.left is None else self.left.high_s

    @property
    def ended(self) -> int:
        """The number of runs that have ended."""
        return sum(self.counts[outcome] for outcome in Outcome if outcome.ended)

    @property
    def ended_badly(self) -> int:
        """Failed runs that can be retried; a run that failed by its verdict would fail again."""
        return sum(count for failure, count in self.failures.items() if isinstance(failure, FailureReason))


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

    ``counts`` as in :class:`ExperimentStatus`; ``failures`` counts all failed runs, retried ones too. Metrics of
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
    ``failures`` (runs by reason) as in :class:`ExperimentStatus`.
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
