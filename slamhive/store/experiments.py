"""Experiments: stored with their cells, paused and cancelled as a whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, and_, func, insert, or_, select, update

from slamhive.domain.run import RunState
from slamhive.domain.visibility import Sharing
from slamhive.errors import Conflict, unknown
from slamhive.store.changes import changes_of
from slamhive.store.experiment_counts import DISTURBED, REPLACEABLE
from slamhive.store.experiment_records import (
    CellRecord,
    CellRun,
    ExperimentRecord,
    NewCell,
)
from slamhive.store.metrics import VERDICT, MetricRepository
from slamhive.store.models import Configuration, Evaluation, Experiment, ExperimentCell, Protocol, Run
from slamhive.store.models import RunEvent as EventRow
from slamhive.store.rows import Repository, chunks, get_or_insert
from slamhive.store.sharing import sharing_columns
from slamhive.store.sight import seeing_all
from slamhive.store.verdicts import kind_of

_EXPERIMENTS = Experiment.__table__
_CELLS = ExperimentCell.__table__
_RUNS = Run.__table__
_ENDED = tuple(state for state in RunState if state.ended)
_RECORD = tuple(ExperimentRecord.__dataclass_fields__)


class ExperimentRepository(Repository):
    """An experiment is one row; its cells and runs refer to it."""

    def get_or_create(self, uid: str, name: str, **values: Any) -> ExperimentRecord:
        """The experiment called ``name``; stored with ``uid`` and ``values`` (its other fields) if there is none."""
        values.update(sharing_columns(Sharing(values.get("owner"), values.get("visibility"))))
        get_or_insert(self._connection, Experiment, {"name": name}, {"uid": uid, **values})
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
        """Whether the file of some experiment contains every part of a dotted name."""
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

    def change(self, experiment_id: int, **values: Any) -> None:
        """Write these fields."""
        self._connection.execute(update(_EXPERIMENTS).where(_EXPERIMENTS.c.id == experiment_id).values(values))
        changes_of(self._connection).experiments.add(experiment_id)

    # -- cells -----------------------------------------------------------------------------------------------------

    def add_cells(self, experiment_id: int, cells: Sequence[NewCell]) -> None:
        """Store cells that are not stored yet."""
        rows = [
            {
                "experiment_id": experiment_id,
                "number": cell.number,
                "configuration_id": cell.configuration_id,
                "name": cell.name,
                "axis_values": dict(cell.values),
            }
            for cell in cells
        ]
        if rows:
            self._connection.execute(insert(_CELLS), rows)
            changes_of(self._connection).cells.append((experiment_id, cells))

    def cell_hashes(self, experiment_id: int, first: int, last: int) -> dict[int, str]:
        """{number: content hash of the configuration} of the stored cells from ``first`` to ``last``."""
        query = (
            select(_CELLS.c.number, Configuration.content_hash)
            .join(Configuration, Configuration.id == _CELLS.c.configuration_id)
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
                Protocol.fingerprint,
            )
            .outerjoin(Protocol, Protocol.id == _RUNS.c.current_protocol_id)
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

    def strangers(self, experiment_id: int) -> int:
        """How many of its runs have a configuration other than that of their cell."""
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
        open_evaluations = select(Evaluation.run_id).where(Evaluation.open.is_not(None))
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
            self._connection.execute(insert(EventRow.__table__), [{"run_id": run_id, **event} for run_id in part])
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
    """Whether another run of the experiment has replaced a run."""
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
