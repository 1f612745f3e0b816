"""The progress of experiments: counts, time left and cells."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean, median, stdev

from slamhive.domain.run import RunState
from slamhive.errors import InvalidInput
from slamhive.services.experiments.context import ExperimentContext
from slamhive.services.experiments.time_left import Left, TimeLeft
from slamhive.services.experiments.views import (
    Cell,
    CellFigures,
    CellPage,
    ExperimentStatus,
    Failure,
    Phase,
    Spread,
    Standing,
    failure_of,
)
from slamhive.store import Transaction
from slamhive.store.experiment_records import CellRecord, CellRun, ExperimentRecord, ExperimentState, StateCount

METRICS = ("ate.rmse", "tracked_fraction", "cpu.mean", "ram.max", "duration")
"""The metrics of cells and reports."""

LARGEST_PAGE = 1000
_MANY = 500
_STANDINGS = {ExperimentState.PAUSED: Standing.PAUSED, ExperimentState.ACTIVE: Standing.ACTIVE}


def all_statuses(t: Transaction) -> tuple[ExperimentStatus, ...]:
    """All experiments, newest first, without the time left."""
    counts, disturbed = t.experiment_counts.by_experiment(), t.experiment_counts.disturbed()
    return tuple(
        status_of(record, counts.get(record.id, []), disturbed.get(record.id, 0)) for record in t.experiments.all()
    )


def status(t: Transaction, name: str, time_left: TimeLeft) -> ExperimentStatus:
    """The experiment called ``name``; raises NotFound."""
    record = t.experiments.get(name)
    counts = t.experiment_counts.by_experiment(record.id).get(record.id, [])
    waiting = sum(entry.count for entry in counts if not entry.state.ended)
    disturbed = t.experiment_counts.disturbed(record.id).get(record.id, 0)
    return status_of(record, counts, disturbed, time_left.of(t, record, waiting))


def status_of(
    record: ExperimentRecord, found: Sequence[StateCount], disturbed: int = 0, left: Left | None = None
) -> ExperimentStatus:
    """The status of an experiment with these counts of runs."""
    counts: Counter[Phase] = Counter()
    failures: Counter[Failure] = Counter()
    retried = 0
    for entry in found:
        if entry.retried:
            retried += entry.count
            continue
        counts[Phase.of(entry.state, entry.judged)] += entry.count
        failure = failure_of(entry)
        if failure is not None:
            failures[failure] += entry.count
    return ExperimentStatus(
        id=record.id,
        name=record.name,
        description=record.description,
        standing=standing_of(record, counts),
        executor=record.executor,
        priority=record.priority,
        repeats=record.repeats,
        created_at=record.created_at,
        cells=record.cells,
        runs=record.runs,
        missing=0 if record.complete else max(0, record.runs - sum(counts.values())),
        counts={phase: counts[phase] for phase in Phase},
        retried=retried,
        failures=dict(failures),
        disturbed=disturbed,
        left=None if left is None else left.time,
        phase="" if left is None else left.phase,
        same_cpu=record.cpu_model is not None,
        cpu_model=record.cpu_model or None,
        owner=record.owner,
        visibility=record.seen_by,
    )


def standing_of(record: ExperimentRecord, counts: Mapping[Phase, int]) -> Standing:
    """The state of an experiment with these runs."""
    if record.state is ExperimentState.CANCELLED:
        return Standing.CANCELLED
    if not record.complete:
        return Standing.STORING
    if not counts.get(Phase.QUEUED) and not counts.get(Phase.RUNNING):
        return Standing.FINISHED
    return _STANDINGS[record.state]


def is_failing(t: Transaction, found: ExperimentStatus, wanted: int) -> bool:
    """Whether the last ``wanted`` runs of an experiment that goes on have all failed; never if that is 0."""
    if not wanted or found.counts[Phase.FAILED] < wanted or found.standing in (Standing.FINISHED, Standing.CANCELLED):
        return False
    ends = t.experiment_counts.last_ended(found.id, wanted)
    return len(ends) == wanted and all(ends)


# -- cells -----------------------------------------------------------------------------------------------------------


def cell_page(t: Transaction, name: str, after: int, limit: int) -> CellPage:
    """The next ``limit`` cells after number ``after``; raises NotFound and InvalidInput."""
    if not 1 <= limit <= LARGEST_PAGE:
        raise InvalidInput(f"page size {limit} is not allowed", f"use 1 to {LARGEST_PAGE}")
    record = t.experiments.get(name)
    found = t.experiments.cells(record.id, after, limit + 1)
    shown = found[:limit]
    more = shown[-1].number if len(found) > limit else None
    return CellPage(tuple(_with_runs(t, record.id, shown)), record.cells, more)


def all_cells(context: ExperimentContext, name: str) -> Iterator[Cell]:
    """All cells in order, read in pages to save memory."""
    after: int | None = 0
    while after is not None:
        page = context.store.read(lambda t, after=after: cell_page(t, name, after, _MANY))  # type: ignore[misc]
        yield from page.cells
        after = page.next_number


def _with_runs(t: Transaction, experiment_id: int, cells: Sequence[CellRecord]) -> Iterator[Cell]:
    if not cells:
        return
    runs: dict[int, list[CellRun]] = defaultdict(list)
    for run in t.experiments.cell_runs(experiment_id, cells[0].number, cells[-1].number, METRICS):
        runs[run.cell].append(run)
    for cell in cells:
        yield _cell(cell, runs[cell.number])


def _cell(cell: CellRecord, runs: Sequence[CellRun]) -> Cell:
    counts = Counter(Phase.of(run.state, run.judged) for run in runs if not run.retried)
    failures = Counter(failure for run in runs if (failure := failure_of(run)) is not None)
    return Cell(
        number=cell.number,
        name=cell.name,
        configuration_id=cell.configuration_id,
        values=cell.values,
        runs=tuple(runs),
        counts={phase: counts[phase] for phase in Phase},
        failures=dict(failures),
        figures=tuple(_figures(runs)),
    )


def _figures(runs: Sequence[CellRun]) -> Iterator[CellFigures]:
    """The metrics of successful runs, by protocol."""
    groups: dict[str | None, list[CellRun]] = defaultdict(list)
    for run in counted_runs(runs):
        if Phase.of(run.state, run.judged) in (Phase.GOOD, Phase.UNJUDGED):
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


def spread(values: Sequence[float]) -> Spread:
    """Mean, median and sample standard deviation of at least one value."""
    return Spread(len(values), fmean(values), median(values), stdev(values) if len(values) > 1 else None)
