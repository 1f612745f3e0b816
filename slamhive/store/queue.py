"""Who works on which run. The database is the queue; a lease per run says who holds it and until when."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, and_, func, insert, or_, select, update
from sqlalchemy.orm import Session

from slamhive.domain.run import RunState
from slamhive.store.models import Run
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

    def claim(self, owner: str, now: datetime, lease_s: float, only: Collection[int] | None = None) -> RunRecord | None:
        """The next run to work on: an orphan if there is one, else the first of the queue; None if there is none.

        ``only`` restricts the choice to these runs.
        """
        return self.adopt(owner, now, lease_s, only) or self.claim_queued(owner, now, lease_s, only)

    def claim_queued(
        self, owner: str, now: datetime, lease_s: float, only: Collection[int] | None = None
    ) -> RunRecord | None:
        """Take the queued run of highest priority, the oldest of those; it is ``preparing`` then."""
        # Two steps through the index (state, priority, id) instead of sorting the whole queue.
        queued = and_(_RUNS.c.state == RunState.QUEUED, *_among(only))
        highest = select(func.max(_RUNS.c.priority)).where(queued).scalar_subquery()
        first = select(func.min(_RUNS.c.id)).where(queued, _RUNS.c.priority == highest)
        while (run_id := self._session.execute(first).scalar_one_or_none()) is not None:
            taken = {**lease(owner, now, lease_s), "state": RunState.PREPARING}
            if self._take(run_id, taken, [queued]):
                event = {"from_state": RunState.QUEUED, "to_state": RunState.PREPARING, "why": f"claimed by {owner}"}
                self._session.execute(insert(EventRow.__table__).values(run_id=run_id, at=now, **event))
                return RunRepository(self._session).get(run_id)
        return None

    def adopt(self, owner: str, now: datetime, lease_s: float, only: Collection[int] | None = None) -> RunRecord | None:
        """Take over an active run whose worker let go of it or went silent, in the state it is in."""
        orphaned = [
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


def _among(only: Collection[int] | None) -> list[ColumnElement[bool]]:
    return [] if only is None else [_RUNS.c.id.in_(sorted(only))]
