"""The queue of runs: which run comes next, and what workers ask about it."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable

from sqlalchemy import ColumnElement, and_, false, func, insert, or_, select, union_all

from slamhive.domain.placement import same_data
from slamhive.domain.run import FailureReason, RunState
from slamhive.store.durations import MeasuredMachine, SameCpu
from slamhive.store.leases import Lease, LeaseQueue
from slamhive.store.models import EvaluationRow, RunEventRow, RunRow
from slamhive.store.records import RunRecord
from slamhive.store.runs import RunRepository

logger = logging.getLogger(__name__)

_RUNS = RunRow.__table__
ACTIVE = tuple(state for state in RunState if state.active)


class RunQueue(LeaseQueue[int]):
    """Runs that wait, and active runs. The next worker adopts what a worker gives back, in the state it is in."""

    table = _RUNS
    queued = RunState.QUEUED
    working = ACTIVE

    def claim(
        self,
        lease: Lease,
        only: Collection[int] | None = None,
        near: str = "",
        away: Collection[str] = (),
        machine: MeasuredMachine | None = None,
    ) -> RunRecord | None:
        """The next run to work on: an orphan if there is one, else the first of the queue; None if there is none.

        Args:
            lease: Who asks, and for how long the run is the owner's.
            only: Restricts the choice to these runs.
            near: The affinity of the run that the owner did last, see :meth:`claim_queued`.
            away: Executors that do not answer; their queued runs stay where they are.
            machine: Of the owner; it gets no run whose experiment stays on another CPU model. None gets any.
        """
        return self.adopt(lease, only, machine) or self.claim_queued(lease, only, near, away, machine)

    def claim_queued(
        self,
        lease: Lease,
        only: Collection[int] | None = None,
        near: str = "",
        away: Collection[str] = (),
        machine: MeasuredMachine | None = None,
    ) -> RunRecord | None:
        """Take a queued run that is not held back, and move it to ``preparing``.

        Only runs of the highest priority count. The oldest with the affinity ``near`` goes first, then the oldest on
        the same data, then the oldest of all.
        """
        reachable = [_RUNS.c.executor.not_in(sorted(away))] if away else []
        queued = and_(_RUNS.c.state == RunState.QUEUED, _RUNS.c.held == false(), *_among(only), *reachable)
        queued = and_(queued, *self._allowed(machine))
        # Other workers ask at the same time. Whoever loses the first run looks again, at most once for each run.
        while (run_id := self._first(queued, near)) is not None:
            other = None if machine is None else SameCpu(self._connection).admits(run_id, machine)
            if other is not None:
                queued = and_(queued, *_not_of([other]))
            elif self._take(run_id, lease, queued, state=RunState.PREPARING):
                event = {"from_state": RunState.QUEUED, "to_state": RunState.PREPARING}
                why = f"claimed by {lease.owner}"
                self._connection.execute(
                    insert(RunEventRow.__table__).values(run_id=run_id, at=lease.at, why=why, **event)
                )
                return RunRepository(self._connection).get(run_id)
        return None

    def ahead_of(self, priority: int) -> int:
        """The number of queued runs that may start before a new one of this priority; paused ones do not."""
        queued = (_RUNS.c.state == RunState.QUEUED, _RUNS.c.held == false(), _RUNS.c.priority >= priority)
        return int(self._connection.execute(select(func.count()).select_from(_RUNS).where(*queued)).scalar_one())

    def adopt(
        self, lease: Lease, only: Collection[int] | None = None, machine: MeasuredMachine | None = None
    ) -> RunRecord | None:
        """Take over an active run whose worker gave it back or went silent, in the state it is in.

        One that has not started stays where it is if its experiment does not let ``machine`` measure it.
        """
        # One state at a time: asked for five at once, SQLite may read the whole table once it has statistics.
        each = [select(_RUNS.c.id).where(_RUNS.c.state == state) for state in ACTIVE]
        active = self._column(union_all(*each))
        begun = [or_(_RUNS.c.state != RunState.PREPARING, allowed) for allowed in self._allowed(machine)]
        orphaned = and_(_RUNS.c.id.in_(active), self._orphaned(lease.now), *_among(only), *begun)
        first = select(_RUNS.c.id).where(orphaned).order_by(_RUNS.c.priority.desc(), _RUNS.c.id).limit(1)
        while (run_id := self._connection.execute(first).scalar_one_or_none()) is not None:
            if self._take(run_id, lease, orphaned):
                record = RunRepository(self._connection).get(run_id)
                logger.info("run %d (%s) is taken over by %s", run_id, record.state, lease.owner)
                return record
        return None

    def waits(self, only: Collection[int] | None = None) -> bool:
        """True if a run is queued that may be claimed."""
        queued = select(_RUNS.c.id).where(_RUNS.c.state == RunState.QUEUED, _RUNS.c.held == false(), *_among(only))
        return self._connection.execute(queued.limit(1)).scalar_one_or_none() is not None

    def lately(self, limit: int) -> list[int]:
        """Active runs, and up to ``limit`` each of those that ended or were evaluated last."""
        each = [select(_RUNS.c.id).where(_RUNS.c.state == state) for state in ACTIVE]
        ended = select(_RUNS.c.id).where(_RUNS.c.ended_at.is_not(None)).order_by(_RUNS.c.ended_at.desc()).limit(limit)
        evaluated = select(EvaluationRow.run_id).order_by(EvaluationRow.id.desc()).limit(limit)
        found: set[int] = set()
        for query in (*each, ended, evaluated):
            found.update(self._column(query))
        return sorted(found)

    def failures_since_asked(self, run: RunRecord) -> int:
        """The number of times that the configuration of ``run`` failed by its own fault since ``run`` was submitted.

        Runs of other experiments and of other cells do not count: they may have had other limits.
        """
        blaming = [reason for reason in FailureReason if reason.blames_configuration]
        failed = select(func.count()).where(
            _RUNS.c.configuration_id == run.configuration_id,
            _RUNS.c.state == RunState.FAILED,
            _RUNS.c.reason.in_(blaming),
            _RUNS.c.ended_at >= run.created_at,
            _RUNS.c.experiment_id.is_not_distinct_from(run.experiment_id),
            _RUNS.c.cell.is_not_distinct_from(run.cell),
        )
        return self._number(failed)

    def _allowed(self, machine: MeasuredMachine | None) -> list[ColumnElement[bool]]:
        """Excludes the experiments that do not let the machine measure their runs; empty if there is none."""
        barred = [] if machine is None else SameCpu(self._connection).barred(machine)
        return _not_of([entry.experiment_id for entry in barred])

    def _first(self, queued: ColumnElement[bool], near: str) -> int | None:
        """The run to take next. Each question is one step through an index: the queue may hold 100,000 runs."""
        highest = self._connection.execute(select(func.max(_RUNS.c.priority)).where(queued)).scalar_one()
        if highest is None:
            return None
        first = select(func.min(_RUNS.c.id)).where(queued, _RUNS.c.priority == highest)
        if near:
            begin, behind = same_data(near)
            on_same_data = select(func.min(_RUNS.c.affinity)).where(
                queued, _RUNS.c.priority == highest, _RUNS.c.affinity >= begin, _RUNS.c.affinity < behind
            )
            same = first.where(_RUNS.c.affinity == near)
            alike = first.where(_RUNS.c.affinity == on_same_data.scalar_subquery())
            for nearer in (same, alike):
                found = self._connection.execute(nearer).scalar_one()
                if found is not None:
                    return int(found)
        oldest = self._connection.execute(first).scalar_one()
        return None if oldest is None else int(oldest)

    def cancel_requested(self, run_ids: Iterable[int]) -> set[int]:
        """Those of these runs that a user has cancelled."""
        wanted = select(_RUNS.c.id).where(_RUNS.c.id.in_(list(run_ids)), _RUNS.c.cancel_requested)
        return set(self._column(wanted))


def _not_of(experiment_ids: Collection[int]) -> list[ColumnElement[bool]]:
    of = _RUNS.c.experiment_id
    return [or_(of.is_(None), of.not_in(sorted(experiment_ids)))] if experiment_ids else []


def _among(only: Collection[int] | None) -> list[ColumnElement[bool]]:
    return [] if only is None else [_RUNS.c.id.in_(sorted(only))]
