"""What a comparison of runs shows, and which runs it accepts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from slamhive.domain.metrics import Metric
from slamhive.domain.numbers import plural
from slamhive.domain.trajectory_kind import TrajectoryKind, with_trajectory
from slamhive.domain.trust import TrustLevel
from slamhive.errors import InvalidInput
from slamhive.input_bounds import whole_number
from slamhive.schema.comparison import ComparedColumn, ComparedMetric, Comparison
from slamhive.services.run_comparison.marks import Part, Unmarked
from slamhive.store.records import RunRecord

FEWEST_RUNS, MOST_RUNS = 2, 20
_LARGEST_ID = 2**53 - 1
_REMEDY = f"name {FEWEST_RUNS} to {MOST_RUNS} runs, for example 3,5,8"


def shown_digits(value: float) -> str:
    """The four significant digits that pages show; values that agree in them are a tie."""
    return f"{value:.4g}"


@dataclass(frozen=True, slots=True)
class RunColumn:
    """One column: a run, or the runs of a configuration. ``failed`` are the members that count as failed."""

    runs: tuple[RunRecord, ...]
    failed: tuple[int, ...]

    @property
    def run_ids(self) -> tuple[int, ...]:
        """The numbers of its runs."""
        return tuple(run.id for run in self.runs)

    @property
    def doubtful(self) -> tuple[int, ...]:
        """The numbers of those of its runs that cannot be trusted fully."""
        return tuple(run.id for run in self.runs if run.trust is not None and run.trust.reasons)

    @property
    def can_be_better(self) -> bool:
        """Whether one of its runs neither failed nor has low trust: its values are those of the algorithm."""
        low = {run.id for run in self.runs if run.trust is not None and run.trust.level is TrustLevel.LOW}
        return any(run_id not in low and run_id not in self.failed for run_id in self.run_ids)


@dataclass(frozen=True, slots=True)
class CommonProtocol:
    """A protocol under which runs of the comparison have metrics, and the runs that lack it but could have it."""

    fingerprint: str
    label: str
    runs: tuple[int, ...]
    lacking: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SettingLine:
    """One setting or parameter: a text for each column, None where the runs do not have it."""

    key: str
    texts: tuple[str | None, ...]

    @property
    def differs(self) -> bool:
        """Whether the columns have different values."""
        return len(set(self.texts)) > 1


@dataclass(frozen=True, slots=True)
class Figure:
    """A metric of a column: the mean over ``count`` runs, with a 95 % interval if there are several."""

    mean: float
    count: int
    low: float | None = None
    high: float | None = None

    @property
    def shown(self) -> str:
        """The mean with the digits that decide on a tie."""
        return shown_digits(self.mean)


@dataclass(frozen=True, slots=True)
class MetricLine:
    """One metric: a value for each column, None where it is missing. ``best`` is the column to mark, None for none."""

    metric: Metric
    figures: tuple[Figure | None, ...]
    best: int | None

    @property
    def differs(self) -> bool:
        """Whether the columns have different values, in the digits that are shown."""
        return len({None if figure is None else figure.shown for figure in self.figures}) > 1

    def document(self, columns: Sequence[str]) -> ComparedMetric:
        """The line as JSON has it; ``columns`` are the names of the columns."""
        return ComparedMetric.of(
            self,
            unit=self.metric.unit,
            better=self.metric.direction,
            best=None if self.best is None else columns[self.best],
            values=dict(zip(columns, self.figures, strict=True)),
        )


@dataclass(frozen=True, slots=True)
class RunComparison:
    """Runs side by side under one protocol; ``protocol`` is None if none of them is evaluated.

    ``unmarked`` says in which metrics the runs are not comparable, so that none is marked as better.
    """

    columns: tuple[RunColumn, ...]
    grouped: bool
    protocols: tuple[CommonProtocol, ...]
    protocol: CommonProtocol | None
    settings: tuple[SettingLine, ...]
    metrics: tuple[MetricLine, ...]
    unmarked: tuple[Unmarked, ...]

    @property
    def runs(self) -> tuple[RunRecord, ...]:
        """All runs, in the order of the columns."""
        return tuple(run for column in self.columns for run in column.runs)

    @property
    def mixed_trajectories(self) -> dict[str, tuple[int, ...]]:
        """The runs by the kind of the trajectory that was judged, if there are several kinds."""
        return mixed_trajectories(self.runs, self.protocol)

    @property
    def marks_nothing(self) -> bool:
        """Whether no metric at all is marked as better."""
        return any(entry.part is Part.ALL for entry in self.unmarked)

    @property
    def single_runs(self) -> bool:
        """Whether each column is one run, so that nobody knows how much repeats would differ."""
        return all(len(column.runs) == 1 for column in self.columns)

    @property
    def address(self) -> str:
        """The path of its page."""
        group = "&group=configuration" if self.grouped else ""
        protocol = "" if self.protocol is None else f"&protocol={self.protocol.fingerprint}"
        return f"/compare?runs={','.join(str(run.id) for run in self.runs)}{group}{protocol}"

    @property
    def document(self) -> Comparison:
        """The comparison as JSON has it."""
        names = [str(column.runs[0].configuration_id if self.grouped else column.runs[0].id) for column in self.columns]
        columns = [ComparedColumn(runs=column.run_ids, failed=column.failed) for column in self.columns]
        return Comparison.of(
            self,
            runs=tuple(run.id for run in self.runs),
            group="configuration" if self.grouped else None,
            columns=dict(zip(names, columns, strict=True)),
            settings={line.key: dict(zip(names, line.texts, strict=True)) for line in self.settings},
            metrics={line.metric.key: line.document(names) for line in self.metrics},
            unmarked="; ".join(entry.words for entry in self.unmarked) or None,
        )


def mixed_trajectories(runs: Sequence[RunRecord], protocol: CommonProtocol | None) -> dict[str, tuple[int, ...]]:
    """The runs by the kind of the trajectory that was judged under ``protocol``; empty if all are of one kind."""
    if protocol is None or with_trajectory(protocol.label, TrajectoryKind.LIVE) == protocol.label:
        return {}
    kinds: dict[str, list[int]] = {}
    for run in runs:
        if run.trajectory is not None and run.id in protocol.runs:
            kinds.setdefault(run.trajectory.value, []).append(run.id)
    return {kind: tuple(members) for kind, members in sorted(kinds.items())} if len(kinds) > 1 else {}


def read_run_ids(texts: Iterable[str]) -> tuple[int, ...]:
    """The numbers of the runs to compare, from texts such as ``3,5,8``.

    Raises:
        InvalidInput: a text is no number, a run is named twice, or there are too few or too many.
    """
    parts = [part.strip() for text in texts for part in text.split(",") if part.strip()]
    if not FEWEST_RUNS <= len(parts) <= MOST_RUNS:
        raise InvalidInput(f"{plural(len(parts), 'run')} cannot be compared", _REMEDY)
    run_ids = tuple(whole_number(part, "run", 1, _LARGEST_ID) for part in parts)
    twice = next((run_id for place, run_id in enumerate(run_ids) if run_id in run_ids[:place]), None)
    if twice is not None:
        raise InvalidInput(f"run {twice} is named twice", "name each run once")
    return run_ids
