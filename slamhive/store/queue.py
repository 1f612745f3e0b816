"""Who works on which run. The database is the queue; a lease per run says who holds it and until when."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, and_, false, func, insert, or_, select, union_all, update
from sqlalchemy.orm import Session

from slamhive.domain.affinity import same_data
from slamhive.domain.run import FailureReason, RunState
from slamhive.store.models import Evaluation, Run
from slamhive.store.models import RunEvent as EventRow
from slamhive.store.records import RunRecord
from slamhive.store.rows import changed, lease
from slamhive.store.runs import RunRepository

logger = logging.getLogger(__name__)

_RUNS = Run.__table__
ACTIVE = tuple(state for state in RunState if state.active)


class QueueRepository:
    """Claims are compare-and-set: of any number of workers that try, one gets the run.

    Leases are compared with the ``now`` that each worker passes in, so clocks of worker hosts must agree to within
    a fraction of the lease.
    """

    def __init__(self, session: Session) -> None:
        self._session = session

    def claim(
        self,
        owner: str,
        now: datetime,
        lease_s: float,
        only: Collection[int] | None = None,
        near: str = "",
        away: Collection[str] = (),
    ) -> RunRecord | None:
        """The next run to work on: an orphan if there is one, else the first of the queue; None if there is none.

        Args:
            owner: Who asks.
            now: When.
            lease_s: For how long the run is the owner's unless it renews the lease.
            only: Restricts the choice to these runs.
            near: The affinity of the run that the owner did last, see :meth:`claim_queued`.
            away: Executors that do not answer; queued runs of theirs are left where they are.
        """
        return self.adopt(owner, now, lease_s, only) or self.claim_queued(owner, now, lease_s, only, near, away)

    def claim_queued(
        self,
        owner: str,
        now: datetime,
        lease_s: float,
        only: Collection[int] | None = None,
        near: str = "",
        away: Collection[str] = (),
    ) -> RunRecord | None:
        """Take a queued run that is not held; it is ``preparing`` then.

        Of those with the highest priority it is the first that there is of: the oldest with the affinity ``near``, the
        oldest on the same data, the oldest.
        """
        queued = and_(_RUNS.c.state == RunState.QUEUED, _RUNS.c.held == false(), *_among(only), *_not_on(away))
        while (run_id := self._first(queued, near)) is not None:
            taken = {**lease(owner, now, lease_s), "state": RunState.PREPARING}
            if self._take(run_id, taken, [queued]):
                event = {"from_state": RunState.QUEUED, "to_state": RunState.PREPARING, "why": f"claimed by {owner}"}
                self._session.execute(insert(EventRow.__table__).values(run_id=run_id, at=now, **event))
                return RunRepository(self._session).get(run_id)
        return None

    def waits(self, only: Collection[int] | None = None) -> bool:
        """Whether a run is queued that may be claimed."""
        queued = select(_RUNS.c.id).where(_RUNS.c.state == RunState.QUEUED, _RUNS.c.held == false(), *_among(only))
        return self._session.execute(queued.limit(1)).scalar_one_or_none() is not None

    def lately(self, limit: int) -> list[int]:
        """Runs that somebody works on, or worked on until lately: so many each that ended or were evaluated last."""
        each = [select(_RUNS.c.id).where(_RUNS.c.state == state) for state in ACTIVE]
        ended = select(_RUNS.c.id).where(_RUNS.c.ended_at.is_not(None)).order_by(_RUNS.c.ended_at.desc()).limit(limit)
        evaluated = select(Evaluation.run_id).order_by(Evaluation.id.desc()).limit(limit)
        found: set[int] = set()
        for query in (*each, ended, evaluated):
            found.update(self._session.execute(query).scalars())
        return sorted(found)

    def failures_since_asked(self, run: RunRecord) -> int:
        """How often the configuration of ``run`` has failed, on its own account, since ``run`` was asked for.

        Runs of other experiments do not count: they may have had other limits.
        """
        blaming = [reason for reason in FailureReason if reason.blames_configuration]
        failed = select(func.count()).where(
            _RUNS.c.configuration_id == run.configuration_id,
            _RUNS.c.state == RunState.FAILED,
            _RUNS.c.reason.in_(blaming),
            _RUNS.c.ended_at >= run.created_at,
            _RUNS.c.experiment_id.is_not_distinct_from(run.experiment_id),
        )
        return int(self._session.execute(failed).scalar_one())

    def _first(self, queued: ColumnElement[bool], near: str) -> int | None:
        """The run to take next. Each question is one step through an index: the queue may hold 100,000 runs."""
        highest = self._session.execute(select(func.max(_RUNS.c.priority)).where(queued)).scalar_one()
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
                found = self._session.execute(nearer).scalar_one()
                if found is not None:
                    return int(found)
        oldest = self._session.execute(first).scalar_one()
        return None if oldest is None else int(oldest)

    def adopt(self, owner: str, now: datetime, lease_s: float, only: Collection[int] | None = None) -> RunRecord | None:
        """Take over an active run whose worker let go of it or went silent, in the state it is in."""
        # One state at a time: asked for five at once, SQLite may rather read the whole table once it has statistics.
        each = [select(_RUNS.c.id).where(_RUNS.c.state == state) for state in ACTIVE]
        active = list(self._session.execute(union_all(*each)).scalars())
        orphaned = [
            _RUNS.c.id.in_(active),
            _RUNS.c.state.in_(ACTIVE),
            or_(_RUNS.c.lease_owner.is_(None), _RUNS.c.lease_expires_at < now),
            *_among(only),
        ]
        first = select(_RUNS.c.id).where(*orphaned).order_by(_RUNS.c.priority.desc(), _RUNS.c.id).limit(1)
        while (run_id := self._session.execute(first).scalar_one_or_none()) is not None:
            if self._take(run_id, lease(owner, now, lease_s), orphaned):
                record = RunRepository(self._session).get(run_id)
                logger.info("run %d, %s, is taken over by %s", run_id, record.state, owner)
                return record
        return None

    def heartbeat(self, run_ids: Iterable[int], owner: str, now: datetime, lease_s: float) -> set[int]:
        """Extend the leases; the runs that ``owner`` still holds. Let go of all others at once."""
        wanted = list(run_ids)
        held = [_RUNS.c.id.in_(wanted), _RUNS.c.lease_owner == owner, _RUNS.c.state.in_(ACTIVE)]
        self._session.execute(update(_RUNS).where(*held).values(lease(owner, now, lease_s)))
        return set(self._session.execute(select(_RUNS.c.id).where(*held)).scalars())

    def cancel_requested(self, run_ids: Iterable[int]) -> set[int]:
        """Which of these runs somebody wants to end."""
        wanted = select(_RUNS.c.id).where(_RUNS.c.id.in_(list(run_ids)), _RUNS.c.cancel_requested)
        return set(self._session.execute(wanted).scalars())

    def release(self, run_ids: Iterable[int], owner: str) -> None:
        """Let go of runs without a move, so that the next worker need not wait for the lease to end."""
        held = [_RUNS.c.id.in_(list(run_ids)), _RUNS.c.lease_owner == owner]
        self._session.execute(update(_RUNS).where(*held).values(lease_owner=None, lease_expires_at=None))

    def owners(self) -> set[str]:
        """Everyone who holds a run."""
        held = select(_RUNS.c.lease_owner).where(_RUNS.c.lease_owner.is_not(None), _RUNS.c.state.in_(ACTIVE))
        return {str(owner) for owner in self._session.execute(held.distinct()).scalars()}

    def release_all(self, owner: str) -> None:
        """Let go of everything that ``owner``, known to be dead, still holds."""
        held = [_RUNS.c.lease_owner == owner]
        self._session.execute(update(_RUNS).where(*held).values(lease_owner=None, lease_expires_at=None))

    def _take(self, run_id: int, lease: dict[str, Any], still: Sequence[ColumnElement[bool]]) -> bool:
        """Write the lease if the run is still as it was when it was looked for."""
        values = {**lease, "attempt": _RUNS.c.attempt + 1}
        return changed(self._session, update(_RUNS).where(_RUNS.c.id == run_id, *still).values(values)) == 1


def _not_on(away: Collection[str]) -> list[ColumnElement[bool]]:
    return [_RUNS.c.executor.not_in(sorted(away))] if away else []


def _among(only: Collection[int] | None) -> list[ColumnElement[bool]]:
    return [] if only is None else [_RUNS.c.id.in_(sorted(only))]
