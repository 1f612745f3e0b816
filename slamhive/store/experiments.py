"""Experiments: stored with their cells, paused and cancelled as a whole."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, ScalarSelect, and_, func, insert, or_, select, update

from slamhive.base.errors import Conflict, unknown
from slamhive.domain.accounts import Sharing
from slamhive.domain.protocol import with_trajectory
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.store.changes import changes_of
from slamhive.store.metrics import CODES, VERDICT, MetricRepository, kind_of
from slamhive.store.models import (
    ConfigurationRow,
    EvaluationRow,
    ExperimentCellRow,
    ExperimentRow,
    MetricRow,
    MetricValueRow,
    ProtocolRow,
    RunEventRow,
    RunRow,
)
from slamhive.store.records import (
    CellRecord,
    CellRun,
    ExperimentRecord,
    ExperimentState,
    ProtocolLabel,
    StateCount,
)
from slamhive.store.rows import Repository, chunks, get_or_insert, insert_many, sample_variance
from slamhive.store.sharing import sharing_columns
from slamhive.store.sight import seeing_all

_RUNS = RunRow.__table__
_FIGURES = MetricValueRow.__table__
REPLACEABLE = (RunState.FAILED, RunState.CANCELLED)
DISTURBED = and_(_RUNS.c.state == RunState.SUCCEEDED, func.coalesce(_RUNS.c.disturbed_by, "") > "")

_Key = tuple[int, RunState, FailureReason | None, VerdictKind | None]
"""Experiment or cell, and what its runs have in common."""


class ExperimentCounts(Repository):
    """Counts from indexes alone, except for the few runs that a verdict failed or that were tried again."""

    def by_experiment(self, experiment_id: int | None = None) -> dict[int, list[StateCount]]:
        """By experiment: of one, or of all."""
        return self._parted(_RUNS.c.experiment_id, experiment_id)

    def by_cell(self, experiment_id: int) -> dict[int, list[StateCount]]:
        """By the cells of one experiment."""
        return self._parted(_RUNS.c.cell, experiment_id)

    def disturbed(self, experiment_id: int | None = None) -> dict[int, int]:
        """The number of runs of each experiment that were measured on a disturbed machine and not repeated since."""
        owner = _RUNS.c.experiment_id
        query = select(owner, func.count()).where(_RUNS.c.disturbed_by > "", _of(experiment_id)).group_by(owner)
        found = {number: count for number, count in self._connection.execute(query)}  # noqa: C416 - rows, not pairs
        if not found:
            return {}
        repeated = Counter(row.experiment_id for row in self._all_retried(experiment_id) if row.disturbed_by)
        return {number: count - repeated[number] for number, count in found.items()}

    def last_ended(self, experiment_id: int, most: int) -> list[bool]:
        """True for each run that failed, among those that ended last; the latest first."""
        query = (
            select(_RUNS.c.id, _RUNS.c.state)
            .where(_RUNS.c.experiment_id == experiment_id, _RUNS.c.ended_at.is_not(None))
            .where(_RUNS.c.state != RunState.CANCELLED)
            .order_by(_RUNS.c.ended_at.desc(), _RUNS.c.id.desc())
            .limit(most)
        )
        rows = self._connection.execute(query).all()
        kinds = self._kinds([row.id for row in rows if row.state is RunState.SUCCEEDED])
        judged = {run_id: kind is not None and kind.failed for run_id, kind in kinds.items()}
        return [row.state is RunState.FAILED or judged.get(row.id, False) for row in rows]

    def _parted(self, place: ColumnElement[int], experiment_id: int | None) -> dict[int, list[StateCount]]:
        """The counts of each place, with retried runs counted separately."""
        counts = self._counts(place, experiment_id)
        if not counts:
            return {}
        retried = self._all_retried(experiment_id)
        kinds = self._kinds([row.id for row in retried if row.state is RunState.SUCCEEDED])
        again: Counter[_Key] = Counter(
            (getattr(row, place.key or ""), row.state, row.reason, kinds.get(row.id)) for row in retried
        )
        found: dict[int, list[StateCount]] = defaultdict(list)
        for key, count in counts.items():
            number, state, reason, judged = key
            parts = ((False, count - again[key]), (True, again[key]))
            found[number] += [StateCount(state, reason, part, many, judged) for part, many in parts if many]
        return found

    def _counts(self, place: ColumnElement[int], experiment_id: int | None) -> Counter[_Key]:
        """Evaluated runs count as good, except for the few whose verdict says otherwise."""
        evaluated = _RUNS.c.current_protocol_id.is_not(None)
        keys = (place, _RUNS.c.state, _RUNS.c.reason, evaluated)
        counts: Counter[_Key] = Counter()
        for number, state, reason, is_evaluated, count in self._connection.execute(
            select(*keys, func.count()).where(_of(experiment_id)).group_by(*keys)
        ):
            counts[number, state, reason, VerdictKind.GOOD if is_evaluated else None] += count
        if not counts:  # no run belongs to an experiment, so that the verdicts of all runs need not be read
            return counts
        verdict = select(MetricRow.id).where(MetricRow.key == VERDICT).scalar_subquery()
        failed = _FIGURES.c.metric_id == verdict, _FIGURES.c.is_current == 1, _FIGURES.c.value > CODES[VerdictKind.GOOD]
        query = (
            select(place, _FIGURES.c.value, func.count())
            .join_from(_FIGURES, _RUNS, _RUNS.c.id == _FIGURES.c.run_id + 0)
            .where(*failed, _of(experiment_id, guarded=True))
            .group_by(place, _FIGURES.c.value)
        )
        for number, code, count in self._connection.execute(query):
            judged = kind_of(code)
            before = None if judged is VerdictKind.NOT_EVALUABLE else VerdictKind.GOOD
            counts[number, RunState.SUCCEEDED, None, before] -= count
            counts[number, RunState.SUCCEEDED, None, judged] += count
        return counts

    def _kinds(self, run_ids: Sequence[int]) -> dict[int, VerdictKind | None]:
        found = MetricRepository(self._connection).for_runs(run_ids, [], verdicts=True)
        return {run_id: kind_of(values.get(VERDICT)) for run_id, values in found.items()}

    def _all_retried(self, experiment_id: int | None) -> Sequence[Any]:
        """The runs that another run has replaced, found through the few retries."""
        later = _RUNS.alias("later")
        columns = (_RUNS.c[name] for name in ("id", "experiment_id", "cell", "state", "reason", "disturbed_by"))
        # Any later run replaces a failed or cancelled one; a good but disturbed one stays if its repeat was cancelled.
        replaced = or_(_RUNS.c.state.in_(REPLACEABLE), and_(DISTURBED, later.c.state != RunState.CANCELLED))
        query = (
            select(*columns)
            .distinct()
            .select_from(later.join(_RUNS, _RUNS.c.id == later.c.retry_of))
            .where(_of(experiment_id, guarded=True), later.c.retry_of.is_not(None), replaced)
        )
        return self._connection.execute(query).all()


def _of(experiment_id: int | None, *, guarded: bool = False) -> ColumnElement[bool]:
    """Test if a run belongs to this experiment, or to any; ``guarded`` keeps its index from being used."""
    owner = _RUNS.c.experiment_id
    if experiment_id is None:
        return owner.is_not(None)
    return (owner + 0 if guarded else owner) == experiment_id


_EXPERIMENTS = ExperimentRow.__table__
_CELLS = ExperimentCellRow.__table__
_ENDED = tuple(state for state in RunState if state.ended)
_RECORD = tuple(ExperimentRecord.__dataclass_fields__)


class ExperimentRepository(Repository):
    """An experiment is one row; its cells and runs refer to it."""

    def get_or_create(self, uid: str, name: str, **values: Any) -> ExperimentRecord:
        """The experiment called ``name``; stored with ``uid`` and ``values`` (its other fields) if there is none."""
        values.update(sharing_columns(Sharing(values.get("owner"), values.get("visibility"))))
        get_or_insert(self._connection, ExperimentRow, {"name": name}, {"uid": uid, **values})
        changes_of(self._connection).started.add(f"experiment {name}")
        return self.get(name)

    def find(self, name: str) -> ExperimentRecord | None:
        """The experiment called ``name``, None if there is none."""
        row = self._connection.execute(select(_EXPERIMENTS).where(_EXPERIMENTS.c.name == name)).one_or_none()
        return None if row is None else _record(row)

    def get(self, name: str) -> ExperimentRecord:
        """The experiment called ``name``; raises NotFound."""
        found = self.find(name)
        if found is None:
            names = self._column(select(_EXPERIMENTS.c.name))
            raise unknown("experiment", name, names, "slamhive experiment list shows all")
        return found

    def check_free(self, name: str) -> None:
        """Raise Conflict if an experiment has this name that the viewer may not see: names are unique for all."""
        query = select(_EXPERIMENTS.c.id).where(_EXPERIMENTS.c.name == name)
        taken = self._connection.scalar(seeing_all(query)) is not None
        if taken and self.find(name) is None:
            raise Conflict(f"the name {name} is taken", "choose another name")

    def mention(self, name: str) -> bool:
        """True if the file of some experiment contains every part of a dotted name."""
        parts = [_EXPERIMENTS.c.source.contains(part, autoescape=True) for part in name.split(".")]
        return self._connection.scalar(select(_EXPERIMENTS.c.id).where(*parts).limit(1)) is not None

    def locked(self, name: str) -> ExperimentRecord:
        """The same, with its row locked until this transaction ends."""
        self._connection.execute(select(_EXPERIMENTS.c.id).where(_EXPERIMENTS.c.name == name).with_for_update())
        return self.get(name)

    def all(self) -> list[ExperimentRecord]:
        """All experiments, the newest first."""
        return [
            _record(row) for row in self._connection.execute(select(_EXPERIMENTS).order_by(_EXPERIMENTS.c.id.desc()))
        ]

    def undecided(self) -> list[ExperimentRecord]:
        """The active experiments that still choose runs, the oldest first."""
        asked = _EXPERIMENTS.c.question.is_not(None), _EXPERIMENTS.c.conclusion.is_(None)
        going_on = _EXPERIMENTS.c.state == ExperimentState.ACTIVE, _EXPERIMENTS.c.complete
        query = select(_EXPERIMENTS).where(*asked, *going_on).order_by(_EXPERIMENTS.c.id)
        return [_record(row) for row in self._connection.execute(query)]

    def durations_s(self, experiment_id: int) -> dict[int, float]:
        """{id: s} of each of its runs that started and ended."""
        times = select(_RUNS.c.id, _RUNS.c.started_at, _RUNS.c.ended_at).where(_RUNS.c.experiment_id == experiment_id)
        ended = times.where(_RUNS.c.started_at.is_not(None), _RUNS.c.ended_at.is_not(None))
        return {row.id: (row.ended_at - row.started_at).total_seconds() for row in self._connection.execute(ended)}

    def change(self, experiment_id: int, **values: Any) -> None:
        """Write these fields."""
        self._connection.execute(update(_EXPERIMENTS).where(_EXPERIMENTS.c.id == experiment_id).values(values))
        changes_of(self._connection).experiments.add(experiment_id)

    # -- cells -----------------------------------------------------------------------------------------------------

    def add_cells(self, experiment_id: int, cells: Sequence[CellRecord]) -> None:
        """Store cells that are not stored yet."""
        names = ("experiment_id", "number", "configuration_id", "name", "axis_values")
        rows = [(experiment_id, cell.number, cell.configuration_id, cell.name, dict(cell.values)) for cell in cells]
        insert_many(self._connection, _CELLS, names, rows)
        if rows:
            changes_of(self._connection).cells.append((experiment_id, cells))

    def cell_hashes(self, experiment_id: int, first: int, last: int) -> dict[int, str]:
        """{number: content hash of the configuration} of the stored cells from ``first`` to ``last``."""
        query = (
            select(_CELLS.c.number, ConfigurationRow.content_hash)
            .join(ConfigurationRow, ConfigurationRow.id == _CELLS.c.configuration_id)
            .where(*_between(_CELLS.c.number, experiment_id, first, last))
        )
        return {row.number: row.content_hash for row in self._connection.execute(query)}

    def cells(self, experiment_id: int, after: int, limit: int | None) -> list[CellRecord]:
        """The next cells after number ``after``, or all of them."""
        query = (
            select(_CELLS)
            .where(_CELLS.c.experiment_id == experiment_id, _CELLS.c.number > after)
            .order_by(_CELLS.c.number)
            .limit(limit)
        )
        return [_cell(row) for row in self._connection.execute(query)]

    def cells_numbered(self, experiment_id: int, numbers: Sequence[int]) -> dict[int, CellRecord]:
        """The cells with these numbers."""
        found = {}
        for part in chunks(numbers):
            mine = select(_CELLS).where(_CELLS.c.experiment_id == experiment_id, _CELLS.c.number.in_(part))
            found.update({row.number: _cell(row) for row in self._connection.execute(mine)})
        return found

    def cell_runs(self, experiment_id: int, first: int, last: int, metrics: Sequence[str]) -> list[CellRun]:
        """The runs of the cells from ``first`` to ``last``, by cell and id, each with these metrics."""
        query = (
            select(
                *(_RUNS.c[name] for name in ("id", "cell", "seed", "state", "reason", "retry_of", "disturbed_by")),
                retried_runs(experiment_id).label("retried"),
                ProtocolRow.fingerprint,
            )
            .outerjoin(ProtocolRow, ProtocolRow.id == _RUNS.c.current_protocol_id)
            .where(*_between(_RUNS.c.cell, experiment_id, first, last))
            .order_by(_RUNS.c.cell, _RUNS.c.id)
        )
        rows = self._connection.execute(query).all()
        figures = MetricRepository(self._connection).for_runs((row.id for row in rows), metrics, verdicts=True)
        return [
            CellRun(
                *(row.id, row.cell, row.seed, row.state, row.reason, bool(row.retried), row.retry_of),
                disturbed=None if row.disturbed_by is None else bool(row.disturbed_by),
                protocol=row.fingerprint,
                judged=kind_of(figures[row.id].pop(VERDICT, None)),
                metrics=figures[row.id],
            )
            for row in rows
        ]

    def to_repeat(self, experiment_id: int) -> list[int]:
        """Ids of the disturbed runs that may be repeated, including those that were."""
        query = select(_RUNS.c.id).where(
            _RUNS.c.experiment_id == experiment_id, _RUNS.c.disturbed_by > "", _RUNS.c.repeat_disturbed > 0
        )
        return self._column(query.order_by(_RUNS.c.id))

    # -- its runs as a whole ---------------------------------------------------------------------------------------

    def run_ids(self, experiment_id: int) -> list[int]:
        """The ids of all its runs, retries included, in order."""
        return self._column(select(_RUNS.c.id).where(_RUNS.c.experiment_id == experiment_id).order_by(_RUNS.c.id))

    def configurations_that_ran(self, experiment_id: int) -> dict[int, int]:
        """The id of the configuration of its runs, by number of the cell."""
        query = select(_RUNS.c.cell, _RUNS.c.configuration_id).where(_RUNS.c.experiment_id == experiment_id).distinct()
        return {row.cell: row.configuration_id for row in self._connection.execute(query) if row.cell is not None}

    def strangers(self, experiment_id: int) -> int:
        """The number of its runs that have a configuration other than that of their cell."""
        same_place = and_(_CELLS.c.experiment_id == _RUNS.c.experiment_id, _CELLS.c.number == _RUNS.c.cell)
        query = (
            select(func.count())
            .select_from(_RUNS.join(_CELLS, same_place))
            .where(_RUNS.c.experiment_id == experiment_id, _RUNS.c.configuration_id != _CELLS.c.configuration_id)
        )
        return self._number(query)

    def unfinished(self, experiment_id: int) -> list[int]:
        """The ids of its runs that have not ended, or whose evaluation has not; in order."""
        mine = _RUNS.c.experiment_id == experiment_id
        open_evaluations = select(EvaluationRow.run_id).where(EvaluationRow.open.is_not(None))
        to_evaluate = and_(_RUNS.c.state == RunState.SUCCEEDED, _RUNS.c.id.in_(open_evaluations))
        query = select(_RUNS.c.id).where(mine, or_(_RUNS.c.state.not_in(_ENDED), to_evaluate)).order_by(_RUNS.c.id)
        return self._column(query)

    def hold(self, experiment_id: int, *, held: bool) -> None:
        """Hold back the runs that have not ended, or release them. A run that a worker holds goes on."""
        unfinished = [_RUNS.c.experiment_id == experiment_id, _RUNS.c.state.not_in(_ENDED)]
        self._connection.execute(update(_RUNS).where(*unfinished).values(held=held))

    def cancel(self, experiment_id: int, now: datetime, why: str) -> tuple[int, int]:
        """Cancel all queued runs and ask the workers of active ones to end; how many of each."""
        mine = _RUNS.c.experiment_id == experiment_id
        queued = self._column(select(_RUNS.c.id).where(mine, _RUNS.c.state == RunState.QUEUED).with_for_update())
        for part in chunks(queued):
            values = {"state": RunState.CANCELLED, "ended_at": now, "held": False}
            self._connection.execute(update(_RUNS).where(_RUNS.c.id.in_(part)).values(values))
            event = {"at": now, "from_state": RunState.QUEUED, "to_state": RunState.CANCELLED, "why": why}
            self._connection.execute(insert(RunEventRow.__table__), [{"run_id": run_id, **event} for run_id in part])
        active = [mine, _RUNS.c.state.not_in((*_ENDED, RunState.QUEUED, RunState.CANCELLING))]
        asked = self._column(select(_RUNS.c.id).where(*active).with_for_update())
        for part in chunks(asked):
            self._connection.execute(
                update(_RUNS).where(_RUNS.c.id.in_(part)).values(cancel_requested=True, held=False)
            )
        changes = changes_of(self._connection)
        changes.cancelled.append((queued, now, why))
        changes.asked_to_end.update(asked)
        return len(queued), len(asked)

    def failed(self, experiment_id: int) -> list[int]:
        """Ids of the failed runs that no other run has replaced."""
        query = select(_RUNS.c.id).where(
            _RUNS.c.experiment_id == experiment_id,
            _RUNS.c.state == RunState.FAILED,
            ~retried_runs(experiment_id),
        )
        return self._column(query.order_by(_RUNS.c.id))


def retried_runs(experiment_id: int) -> ColumnElement[bool]:
    """Test if another run of the experiment has replaced a run."""
    later = _RUNS.alias("later")
    mine = select(later.c.retry_of).where(later.c.retry_of.is_not(None), later.c.experiment_id == experiment_id)
    going_on = mine.where(later.c.state != RunState.CANCELLED)
    return or_(and_(_RUNS.c.state.in_(REPLACEABLE), _RUNS.c.id.in_(mine)), and_(DISTURBED, _RUNS.c.id.in_(going_on)))


def _between(column: ColumnElement[Any], experiment_id: int, first: int, last: int) -> list[ColumnElement[bool]]:
    owner = column.table.c.experiment_id
    return [owner == experiment_id, column >= first, column <= last]


def _record(row: Any) -> ExperimentRecord:
    return ExperimentRecord(**{name: getattr(row, name) for name in _RECORD})


def _cell(row: Any) -> CellRecord:
    return CellRecord(row.number, row.name, row.configuration_id, _values(row.axis_values))


def _values(stored: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in stored.items()}


# -- the values that rank configurations -------------------------------------------------------------------------------

_JUDGED = (RunState.SUCCEEDED, RunState.FAILED)


@dataclass(frozen=True, slots=True)
class CellSample:
    """The good runs of a cell under one protocol: how many, and mean and sample variance of a metric in its unit."""

    cell: int
    protocol: ProtocolLabel
    n: int
    mean: float
    variance: float


class ExperimentValues(Repository):
    """Values that rank the configurations of an experiment. Runs that another run has replaced do not count."""

    def samples(self, experiment_id: int, metric: str) -> list[CellSample]:
        """Of each cell, under the current protocols of its good runs.

        If both live and final trajectories were judged, they are apart, and the labels name them.
        """
        verdict = _FIGURES.alias("verdict")
        is_verdict = and_(
            verdict.c.run_id == _RUNS.c.id, verdict.c.metric_id == _id_of(VERDICT), verdict.c.is_current == 1
        )
        value = _FIGURES.c.value
        evaluated = (_RUNS.c.experiment_id == experiment_id, _RUNS.c.current_protocol_id.is_not(None))
        stated = select(_RUNS.c.trajectory).where(*evaluated, _RUNS.c.trajectory.is_not(None)).distinct()
        kinds = [_RUNS.c.trajectory] if len(self._column(stated)) > 1 else []
        query = (
            select(
                _RUNS.c.cell,
                ProtocolRow.fingerprint,
                ProtocolRow.label,
                func.count(),
                func.avg(value),
                func.avg(value * value),
                *kinds,
            )
            .join_from(_RUNS, _FIGURES, _FIGURES.c.run_id == _RUNS.c.id)
            .join(ProtocolRow, ProtocolRow.id == _FIGURES.c.protocol_id)
            .outerjoin(verdict, is_verdict)
            .where(_RUNS.c.experiment_id == experiment_id, _RUNS.c.state == RunState.SUCCEEDED)
            .where(_FIGURES.c.metric_id == _id_of(metric), _FIGURES.c.is_current == 1)
            .where(or_(verdict.c.value.is_(None), verdict.c.value <= CODES[VerdictKind.GOOD]))
            .where(~retried_runs(experiment_id))
            .group_by(_RUNS.c.cell, ProtocolRow.fingerprint, ProtocolRow.label, *kinds)
        )
        return [
            CellSample(
                cell,
                ProtocolLabel(fingerprint, with_trajectory(label, kind[0] if kind else None)),
                n,
                mean,
                sample_variance(n, mean, square),
            )
            for cell, fingerprint, label, n, mean, square, *kind in map(tuple, self._connection.execute(query))
        ]

    def judged_runs(self, experiment_id: int, cells: Sequence[int], most: int) -> dict[int, list[int]]:
        """{cell: its latest runs that succeeded or failed, at most ``most``, in order}."""
        found: dict[int, list[int]] = defaultdict(list)
        for part in chunks(cells):
            query = (
                select(_RUNS.c.cell, _RUNS.c.id)
                .where(_RUNS.c.experiment_id == experiment_id, _RUNS.c.cell.in_(part), _RUNS.c.state.in_(_JUDGED))
                .where(~retried_runs(experiment_id))
                .order_by(_RUNS.c.id)
            )
            for cell, run_id in self._connection.execute(query):
                found[cell].append(run_id)
        return {cell: runs[-most:] for cell, runs in found.items()}


def _id_of(metric: str) -> ScalarSelect[int]:
    return select(MetricRow.id).where(MetricRow.key == metric).scalar_subquery()
