"""Progress of experiments: the time left, counts of runs, cells, and the grid over two axes."""

from __future__ import annotations

import math
import threading
from collections import Counter, OrderedDict, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median, stdev
from typing import TYPE_CHECKING, NamedTuple

from slamhive.base.clock import SYSTEM_CLOCK, Clock
from slamhive.base.errors import InvalidInput, unknown
from slamhive.documents.plain import ConfigurationStanding, ExperimentStatusDocument
from slamhive.domain.names import plural
from slamhive.domain.parameters import Value
from slamhive.domain.placement import Remaining
from slamhive.domain.run import RunState
from slamhive.domain.verdict import Failure, Outcome, failure_of
from slamhive.services.experiments.context import Costs, Expected, ExperimentContext, guessed_duration_s
from slamhive.services.experiments.views import (
    MOST_LISTED,
    Cell,
    CellFigures,
    CellPage,
    ExperimentGrid,
    GridCell,
    MeanOfRuns,
    MetricGrid,
    MetricSpread,
)
from slamhive.store import Transaction
from slamhive.store.durations import ActiveRun
from slamhive.store.experiments import CellSample
from slamhive.store.records import CellRecord, CellRun, ExperimentRecord, ExperimentState, ProtocolLabel, StateCount
from slamhive.store.rows import sample_variance

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Integers = NDArray[np.int32]

MANY_RUNS = 5000
"""From this many waiting runs on, the means are kept for a while: they change slowly and cost a look at each run."""
KEPT_S = 60.0
_OVERDUE = 4 / 3
"""A run or build that has taken longer than expected is expected to take this many times what it has taken so far."""


class Left(NamedTuple):
    """Time until everything has ended, and what happens now in words."""

    time: Remaining
    phase: str


@dataclass(frozen=True, slots=True)
class _Means:
    """Mean times per run, evaluation and build of one experiment.

    ``of_run`` is the mean of the runs that have not ended, from claim to end. ``measured``: runs like them have run.
    ``unbuilt`` are the packages without an image yet. ``evaluated_fraction`` of the waiting runs will be evaluated.
    """

    of_run: Expected
    of_evaluation: Expected
    of_build: Expected
    measured: bool
    unbuilt: tuple[str, ...]
    evaluated_fraction: float
    looked_at: float


class TimeLeft:
    """Estimate of the time left, from runs of the experiment itself, else other runs, else the recordings' durations.

    With the means B of a build, R of a run and E of an evaluation::

        work = (unbuilt * B - passed) + (waiting * R - passed) + (open + waiting * evaluated_fraction) * E
        time = work / min(slots, max(waiting, open))

    ``passed`` is what the builds and runs under way have already done of their expected time. The interval follows from
    the variances (:class:`Expected`, :class:`Amount`). Thread-safe.

    Args:
        slots: Runs at a time.
        clock: Says for how long runs have been under way.
    """

    def __init__(self, slots: int, clock: Clock = SYSTEM_CLOCK) -> None:
        self._slots = slots
        self._clock = clock
        self._lock = threading.Lock()
        self._means: dict[int, _Means] = {}

    def of(self, t: Transaction, record: ExperimentRecord, waiting: int) -> Left:
        """Estimate the time until the ``waiting`` runs have ended and all runs of the experiment are evaluated."""
        evaluations = t.durations.open_evaluations(record.id)
        if not waiting and not evaluations:
            return Left(Remaining(0.0, 0.0, 0.0), "")
        means = self._known(record.id, waiting) or self._look(t, record.id)
        active = t.durations.active(record.id)
        building = {run.package: run for run in active if _builds(run, means)}
        running = [run for run in active if not _builds(run, means)]
        # A guess grows with what contradicts it: a build or run under way that takes longer. Measured means stay.
        of_build = self._no_less(means.of_build, building.values())
        of_run = means.of_run if means.measured else self._no_less(means.of_run, running)
        built_s = sum(self._passed_s(building.get(name), of_build.seconds) for name in means.unbuilt)
        ran_s = sum(self._passed_s(run, of_run.seconds) for run in running)
        amount = (
            of_build.times(len(means.unbuilt), built_s)
            + of_run.times(waiting, ran_s)
            + means.of_evaluation.times(evaluations + waiting * means.evaluated_fraction)
        )
        # Fewer things left than slots: the others stay idle.
        time = amount.remaining(min(self._slots, max(waiting, evaluations)))
        measured = means.measured if waiting else not means.of_evaluation.guessed_s
        bound = f", runs stay on {record.cpu_model}" if record.cpu_model else ""
        # Such as ``building aloam, 2 runs under way, 3 evaluations to do``.
        under_way = sum(run.state is not RunState.PREPARING for run in active)
        preparing = len(active) - under_way - len(building)
        parts = [f"building {', '.join(building)}"] if building else []
        parts += [f"preparing {plural(preparing, 'run')}"] if preparing > 0 else []
        parts += [f"{plural(under_way, 'run')} under way"] if under_way else []
        parts += [f"{plural(evaluations, 'evaluation')} to do"] if evaluations else []
        phase = ", ".join(parts) or f"waiting for a worker{bound}"
        return Left(time if measured else Remaining(time.seconds), phase)

    def _no_less(self, expected: Expected, under_way: Iterable[ActiveRun]) -> Expected:
        """Raise a guess to what the longest of ``under_way`` is expected to take; leave a measured mean alone."""
        longest_s = max((_OVERDUE * self._elapsed_s(run) for run in under_way), default=0.0)
        return Expected.guess(longest_s) if expected.guessed_s and longest_s > expected.seconds else expected

    def _passed_s(self, run: ActiveRun | None, expected_s: float) -> float:
        """Return the part of the expected time that has passed; negative if the run takes much longer than expected.

        What remains is max(expected - elapsed, elapsed / 3): an overdue run is taken to need a third of its time
        again, as its end moves away the longer it takes.
        """
        elapsed_s = 0.0 if run is None else self._elapsed_s(run)
        return expected_s - max(expected_s - elapsed_s, (_OVERDUE - 1) * elapsed_s)

    def _elapsed_s(self, run: ActiveRun) -> float:
        return (self._clock.utc_now() - run.claimed_at).total_seconds()

    def _known(self, experiment_id: int, waiting: int) -> _Means | None:
        with self._lock:
            means = self._means.get(experiment_id)
        fresh = means is not None and waiting >= MANY_RUNS and self._clock.monotonic_s() - means.looked_at <= KEPT_S
        return means if fresh else None

    def _look(self, t: Transaction, experiment_id: int) -> _Means:
        waiting = t.durations.unfinished(experiment_id)
        runs = max(1, sum(count.runs for count in waiting.values()))
        costs = Costs.look(t)
        own, others = t.durations.of_pairings(experiment_id), t.durations.of_pairings()
        recordings_s = {dataset.name: dataset.duration_s for dataset in t.catalogue.datasets()}
        expected = []
        for pairing, count in waiting.items():
            measured = own.get(pairing, others.get(pairing))
            if measured is None:
                expected.append((count.runs, Expected.guess(guessed_duration_s(pairing, recordings_s[pairing[1]]))))
            else:
                expected.append((count.runs, Expected.of(measured)))
        means = _Means(
            of_run=Expected.mean(expected) + costs.overhead,
            of_evaluation=costs.evaluation,
            of_build=costs.build,
            measured=any(not each.guessed_s for _, each in expected),
            unbuilt=tuple(t.durations.unbuilt(experiment_id)),
            evaluated_fraction=sum(count.to_evaluate for count in waiting.values()) / runs,
            looked_at=self._clock.monotonic_s(),
        )
        with self._lock:
            self._means[experiment_id] = means
        return means


def _builds(run: ActiveRun, means: _Means) -> bool:
    return run.state is RunState.PREPARING and run.package in means.unbuilt


METRICS = ("ate.rmse", "tracked_fraction", "cpu.mean", "ram.max", "duration")
"""The metrics of cells and reports."""

LARGEST_PAGE = 1000
_MANY = 500
_STANDINGS = {
    ExperimentState.PAUSED: ConfigurationStanding.PAUSED,
    ExperimentState.ACTIVE: ConfigurationStanding.ACTIVE,
}


def all_statuses(t: Transaction) -> tuple[ExperimentStatusDocument, ...]:
    """All experiments, newest first, without the time left."""
    counts, disturbed = t.experiment_counts.by_experiment(), t.experiment_counts.disturbed()
    return tuple(
        status_of(record, counts.get(record.id, []), disturbed.get(record.id, 0)) for record in t.experiments.all()
    )


def status(t: Transaction, name: str, time_left: TimeLeft) -> ExperimentStatusDocument:
    """The experiment called ``name``; raises NotFound."""
    record = t.experiments.get(name)
    counts = t.experiment_counts.by_experiment(record.id).get(record.id, [])
    waiting = sum(entry.count for entry in counts if not entry.state.ended)
    disturbed = t.experiment_counts.disturbed(record.id).get(record.id, 0)
    return status_of(record, counts, disturbed, time_left.of(t, record, waiting))


def status_of(
    record: ExperimentRecord, found: Sequence[StateCount], disturbed: int = 0, left: Left | None = None
) -> ExperimentStatusDocument:
    """The status of an experiment with these counts of runs."""
    counts: Counter[Outcome] = Counter()
    failures: Counter[Failure] = Counter()
    retried = 0
    for entry in found:
        if entry.retried:
            retried += entry.count
            continue
        counts[Outcome.of(entry)] += entry.count
        failure = failure_of(entry)
        if failure is not None:
            failures[failure] += entry.count
    return ExperimentStatusDocument(
        number=record.id,
        name=record.name,
        description=record.description,
        state=standing_of(record, counts),
        executor=record.executor,
        priority=record.priority,
        repeats=record.repeats,
        created_at=record.created_at,
        cells=record.cells,
        runs=record.runs,
        missing=0 if record.complete else max(0, record.runs - sum(counts.values())),
        counts={outcome: counts[outcome] for outcome in Outcome},
        retried=retried,
        failures=dict(failures),
        disturbed=disturbed,
        left_s=None if left is None else left.time.seconds,
        low_s=None if left is None else left.time.low_s,
        high_s=None if left is None else left.time.high_s,
        phase="" if left is None else left.phase or ("choosing the next runs" if record.undecided else ""),
        same_cpu=record.cpu_model is not None,
        cpu_model=record.cpu_model or None,
        question=record.question,
        conclusion=record.conclusion,
        owner=record.owner,
        visibility=record.seen_by,
    )


def standing_of(record: ExperimentRecord, counts: Mapping[Outcome, int]) -> ConfigurationStanding:
    """The state of an experiment with these runs."""
    if record.state is ExperimentState.CANCELLED:
        return ConfigurationStanding.CANCELLED
    if not record.complete:
        return ConfigurationStanding.STORING
    if not counts.get(Outcome.QUEUED) and not counts.get(Outcome.RUNNING) and not record.undecided:
        return ConfigurationStanding.FINISHED
    return _STANDINGS[record.state]


def is_failing(t: Transaction, found: ExperimentStatusDocument, wanted: int) -> bool:
    """Tell if the last ``wanted`` runs of an experiment that goes on have all failed; never if that is 0."""
    if (
        not wanted
        or found.counts[Outcome.FAILED] + found.counts[Outcome.LOST] < wanted
        or found.state in (ConfigurationStanding.FINISHED, ConfigurationStanding.CANCELLED)
    ):
        return False
    ends = t.experiment_counts.last_ended(found.number, wanted)
    return len(ends) == wanted and all(ends)


def cell_page(t: Transaction, name: str, after: int, limit: int) -> CellPage:
    """The next ``limit`` cells after number ``after``; raises NotFound and InvalidInput."""
    if not 1 <= limit <= LARGEST_PAGE:
        raise InvalidInput(f"page size {limit} is not allowed", f"use 1 to {LARGEST_PAGE}")
    record = t.experiments.get(name)
    found = t.experiments.cells(record.id, after, limit + 1)
    shown = found[:limit]
    more = shown[-1].number if len(found) > limit else None
    runs: dict[int, list[CellRun]] = defaultdict(list)
    if shown:
        for run in t.experiments.cell_runs(record.id, shown[0].number, shown[-1].number, METRICS):
            runs[run.cell].append(run)
    return CellPage(tuple(_cell(cell, runs[cell.number]) for cell in shown), record.cells, more)


def all_cells(context: ExperimentContext, name: str) -> Iterator[Cell]:
    """All cells in order, read in pages to save memory."""
    after: int | None = 0
    while after is not None:
        page = context.store.read(lambda t, after=after: cell_page(t, name, after, _MANY))  # type: ignore[misc]
        yield from page.cells
        after = page.next_number


def _cell(cell: CellRecord, runs: Sequence[CellRun]) -> Cell:
    counts = Counter(Outcome.of(run) for run in runs if not run.retried)
    failures = Counter(failure for run in runs if (failure := failure_of(run)) is not None)
    return Cell(
        number=cell.number,
        name=cell.name,
        configuration_id=cell.configuration_id,
        values=cell.values,
        runs=tuple(runs),
        counts={outcome: counts[outcome] for outcome in Outcome},
        failures=dict(failures),
        figures=tuple(_figures(runs)),
    )


def _figures(runs: Sequence[CellRun]) -> Iterator[CellFigures]:
    """The metrics of successful runs, by protocol."""
    groups: dict[str | None, list[CellRun]] = defaultdict(list)
    for run in counted_runs(runs):
        if Outcome.of(run) in (Outcome.GOOD, Outcome.UNJUDGED):
            groups[run.protocol].append(run)
    for protocol in sorted(groups, key=str):
        values: dict[str, list[float]] = defaultdict(list)
        for run in groups[protocol]:
            for key, value in run.metrics.items():
                values[key].append(value)
        spreads = {key: spread(values[key]) for key in METRICS if key in values}
        disturbed = sum(bool(run.disturbed) for run in groups[protocol])
        yield CellFigures(protocol, len(groups[protocol]), disturbed, spreads)


def counted_runs(runs: Sequence[CellRun]) -> list[CellRun]:
    """The runs of a cell without disturbed ones whose repetition has succeeded or failed.

    Until then the disturbed run counts. The last repetition counts even if it was disturbed as well.
    """
    places: dict[int, int] = {}
    last: dict[int, int] = {}
    for run in runs:
        first = run.id if run.retry_of is None else places.get(run.retry_of, run.retry_of)
        places[run.id] = first
        if run.state in (RunState.SUCCEEDED, RunState.FAILED):
            last[first] = run.id
    return [run for run in runs if not run.disturbed or last.get(places[run.id], run.id) == run.id]


def spread(values: Sequence[float]) -> MetricSpread:
    """Mean, median and sample standard deviation of at least one value."""
    return MetricSpread(len(values), fmean(values), median(values), stdev(values) if len(values) > 1 else None)


MOST_TABLES = 8
"""Kept in memory; one of 100,000 cells and 10 axes takes 5 MB."""

Key = tuple[str, Value | None]
CellCounts = Mapping[int, Sequence[StateCount]]
"""Runs by the number of their cell."""


@dataclass(frozen=True, slots=True)
class AxisTable:
    """Axis values of the cells of an experiment, as arrays that are read once: cells never change.

    ``numbers`` and ``configurations``, shape (n,), are the ascending cell numbers and their configurations. For each
    axis, ``values`` holds its values in order of appearance; the last is None if the axis does not apply to some cells.
    ``codes``, shape (n,), holds the index of each cell's value.
    """

    numbers: Integers
    configurations: Integers
    values: Mapping[str, tuple[Value | None, ...]]
    codes: Mapping[str, Integers]

    @classmethod
    def of(cls, cells: Iterable[CellRecord]) -> AxisTable:
        """Build the table from cells in order."""
        import numpy as np  # noqa: PLC0415 - lists of experiments have no table

        numbers: list[int] = []
        configurations: list[int] = []
        places: dict[str, dict[Key, int]] = {}
        found: dict[str, list[int]] = {}
        for cell in cells:
            for axis, value in cell.values.items():
                codes = found.setdefault(axis, [])
                codes += [-1] * (len(numbers) - len(codes))
                own = places.setdefault(axis, {})
                codes.append(own.setdefault((type(value).__name__, value), len(own)))
            numbers.append(cell.number)
            configurations.append(cell.configuration_id)
        values: dict[str, tuple[Value | None, ...]] = {}
        arrays: dict[str, Integers] = {}
        for axis, codes in found.items():
            array = np.array(codes + [-1] * (len(numbers) - len(codes)), dtype=np.int32)
            known = tuple(value for _, value in places[axis])
            values[axis] = (*known, None) if (array < 0).any() else known
            arrays[axis] = np.where(array < 0, np.int32(len(known)), array)
        return cls(np.array(numbers, dtype=np.int32), np.array(configurations, dtype=np.int32), values, arrays)

    @property
    def axes(self) -> dict[str, tuple[Value, ...]]:
        """The axes with all values, in the order of the file."""
        return {axis: tuple(value for value in values if value is not None) for axis, values in self.values.items()}

    def grid(self, axes: tuple[str, str], counts: CellCounts, name: str) -> ExperimentGrid:
        """Runs by outcome over two axes.

        Args:
            axes: The axis of the rows and that of the columns.
            counts: The runs of the cells, without retried ones.
            name: The name of the experiment, for messages.
        """
        import numpy as np  # noqa: PLC0415

        rows, columns = (self._axis(axis, name) for axis in axes)
        outcomes = list(Outcome)
        shape = (len(self.values[axes[0]]), len(self.values[axes[1]]))
        place = rows.astype(np.int64) * shape[1] + columns
        used, first, members = np.unique(place, return_index=True, return_counts=True)
        together = np.split(self.configurations[np.argsort(place, kind="stable")], np.cumsum(members)[:-1])
        entries = [(cell, entry) for cell, found in counts.items() for entry in found if not entry.retried]
        index = [outcomes.index(Outcome.of(entry)) for _, entry in entries]
        numbers = [(cell, outcome, entry.count) for (cell, entry), outcome in zip(entries, index, strict=True)]
        table = np.array(numbers, dtype=np.int64).reshape(-1, 3)
        of_cell = place[np.searchsorted(self.numbers, table[:, 0])]
        sums = np.zeros((shape[0] * shape[1], len(outcomes)), dtype=np.int64)
        np.add.at(sums, (of_cell, table[:, 1]), table[:, 2])
        failures: dict[int, Counter[Failure]] = defaultdict(Counter)
        for at, (_, entry) in zip(of_cell, entries, strict=True):
            failure = failure_of(entry)
            if failure is not None:
                failures[int(at)][failure] += entry.count
        return ExperimentGrid(
            *axes,
            rows=self.values[axes[0]],
            columns=self.values[axes[1]],
            cells={
                divmod(int(at), shape[1]): GridCell(
                    int(number),
                    int(self.numbers[start]),
                    tuple(map(int, configurations)) if number <= MOST_LISTED else (),
                    dict(zip(outcomes, map(int, sums[at]), strict=True)),
                    dict(failures.get(int(at), {})),
                )
                for at, start, number, configurations in zip(used, first, members, together, strict=True)
            },
        )

    def means(self, axes: tuple[str, str], samples: Sequence[CellSample], name: str) -> MetricGrid:
        """Means over two axes, from the samples of the cells; the other arguments are those of :meth:`grid`."""
        import numpy as np  # noqa: PLC0415

        rows, columns = (self._axis(axis, name) for axis in axes)
        weights: Counter[ProtocolLabel] = Counter()
        for sample in samples:
            weights[sample.protocol] += sample.n
        protocol = weights.most_common(1)[0][0] if weights else None
        # Sums of the values and of their squares around 0 pool the samples of several cells.
        pooled: dict[tuple[int, int], tuple[int, float, float]] = {}
        for sample in samples:
            if sample.protocol != protocol:
                continue
            at = int(np.searchsorted(self.numbers, sample.cell))
            place = int(rows[at]), int(columns[at])
            n, total, squares = pooled.get(place, (0, 0.0, 0.0))
            own = sample.variance * (sample.n - 1) + sample.n * sample.mean**2
            pooled[place] = n + sample.n, total + sample.n * sample.mean, squares + own
        cells = {
            place: MeanOfRuns(n, total / n, math.sqrt(sample_variance(n, total / n, squares / n)) if n > 1 else None)
            for place, (n, total, squares) in pooled.items()
        }
        others = weights.total() - (weights[protocol] if protocol else 0)
        return MetricGrid(protocol, others, cells)

    def _axis(self, axis: str, name: str) -> Integers:
        if axis not in self.codes:
            raise unknown(f"axis of experiment {name}", axis, list(self.codes))
        return self.codes[axis]


class AxisTables:
    """A cache of tables, safe for several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._tables: OrderedDict[int, AxisTable] = OrderedDict()

    def get(self, t: Transaction, record: ExperimentRecord) -> AxisTable:
        """The table of ``record``; it is not cached while cells are still being stored."""
        with self._lock:
            known = self._tables.get(record.id)
            if known is not None:
                self._tables.move_to_end(record.id)
        if known is not None and len(known.numbers) == record.cells:
            return known
        table = AxisTable.of(t.experiments.cells(record.id, 0, None))
        with self._lock:
            self._tables[record.id] = table
            while len(self._tables) > MOST_TABLES:
                self._tables.popitem(last=False)
        return table
