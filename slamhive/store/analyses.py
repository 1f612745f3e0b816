"""Analyses: their list, and their own little queue."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, Row, delete, func, insert, or_, select, update
from sqlalchemy.orm import Session

from slamhive.errors import NotFound
from slamhive.store.analysis_records import AnalysisRecord, AnalysisState
from slamhive.store.models import Analysis, Evaluation, Run
from slamhive.store.records import LeaseLost
from slamhive.store.rows import changed, chunks, cut, lease

REASON_LENGTH = 10_000
_TABLE = Analysis.__table__
_FREE: dict[str, Any] = {"lease_owner": None, "lease_expires_at": None}


class AnalysisRepository:
    """One worker computes an analysis at a time; one that dies leaves it to the next."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def put(self, record: AnalysisRecord) -> None:
        """File an analysis as its folder tells it; the same call again is fine. Whoever computes it has lost it."""
        values = {
            "name": record.name,
            "state": record.state,
            "listed": record.listed,
            "visitor": record.visitor,
            "created_at": record.created_at,
            "content_hash": record.content_hash,
            "reason": cut(record.reason, REASON_LENGTH),
            "size_bytes": record.size_bytes,
            "ended_at": record.ended_at,
            "attempt": 0,
            **_FREE,
        }
        if not changed(self._session, update(_TABLE).where(_TABLE.c.token == record.token).values(values)):
            self._session.execute(insert(_TABLE).values(token=record.token, **values))

    def get(self, token: str) -> AnalysisRecord:
        """The analysis at this address; raises NotFound."""
        found = self._records(_TABLE.c.token == token)
        if not found:
            raise NotFound("there is no analysis at this address", "it may have been deleted")
        return found[0]

    def listed(self, limit: int) -> list[AnalysisRecord]:
        """The listed ones, newest first."""
        query = select(_TABLE).where(_TABLE.c.listed == True).order_by(_TABLE.c.id.desc()).limit(limit)  # noqa: E712
        return [_record(row) for row in self._session.execute(query)]

    def visitors(self) -> list[AnalysisRecord]:
        """Those that were made in view-only mode, oldest first."""
        return self._records(_TABLE.c.visitor == True)  # noqa: E712

    def waiting(self) -> int:
        """How many are not computed yet."""
        open_ones = _TABLE.c.state.in_((AnalysisState.QUEUED, AnalysisState.RUNNING))
        return int(self._session.execute(select(func.count()).select_from(_TABLE).where(open_ones)).scalar_one())

    def same(self, content_hash: str) -> list[str]:
        """The addresses of those that show the same and are done, newest first."""
        query = select(_TABLE.c.token).where(
            _TABLE.c.content_hash == content_hash, _TABLE.c.state == AnalysisState.DONE
        )
        return list(self._session.execute(query.order_by(_TABLE.c.id.desc())).scalars())

    def list_or_not(self, token: str, *, listed: bool) -> None:
        """Show it in the list, or only at its address. Raises NotFound."""
        self.get(token)
        self._session.execute(update(_TABLE).where(_TABLE.c.token == token).values(listed=listed))

    def delete(self, token: str) -> bool:
        """Forget it; whether it was there. Whoever computes it finds out with the next heartbeat."""
        return changed(self._session, delete(_TABLE).where(_TABLE.c.token == token)) == 1

    # -- the queue -------------------------------------------------------------------------------------------------

    def claim(self, owner: str, now: datetime, lease_s: float) -> AnalysisRecord | None:
        """Take the oldest that waits, or whose worker went silent; None if there is none."""
        free = or_(
            _TABLE.c.state == AnalysisState.QUEUED,
            (_TABLE.c.state == AnalysisState.RUNNING)
            & (_TABLE.c.lease_owner.is_(None) | (_TABLE.c.lease_expires_at < now)),
        )
        values = {"state": AnalysisState.RUNNING, "attempt": _TABLE.c.attempt + 1, **lease(owner, now, lease_s)}
        for found in self._session.execute(select(_TABLE.c.id).where(free).order_by(_TABLE.c.id).limit(5)).scalars():
            if changed(self._session, update(_TABLE).where(_TABLE.c.id == found, free).values(values)) == 1:
                return self._records(_TABLE.c.id == found)[0]
        return None

    def heartbeat(self, token: str, owner: str, now: datetime, lease_s: float) -> bool:
        """Extend the lease; whether ``owner`` still holds it. False once it is deleted or queued anew."""
        held = [_TABLE.c.token == token, _TABLE.c.lease_owner == owner]
        self._session.execute(update(_TABLE).where(*held).values(lease(owner, now, lease_s)))
        return self._session.execute(select(_TABLE.c.id).where(*held)).first() is not None

    def finish(self, record: AnalysisRecord, owner: str) -> None:
        """File the end of an analysis that ``owner`` computes; raises LeaseLost if it holds it no more."""
        values = {
            "state": record.state,
            "content_hash": record.content_hash,
            "reason": cut(record.reason, REASON_LENGTH),
            "size_bytes": record.size_bytes,
            "ended_at": record.ended_at,
            **_FREE,
        }
        held = [_TABLE.c.token == record.token, _TABLE.c.lease_owner == owner]
        if changed(self._session, update(_TABLE).where(*held).values(values)) != 1:
            raise LeaseLost(f"analysis {record.token} was deleted, or taken over by another worker")

    def release(self, token: str, owner: str) -> None:
        """Put back what ``owner`` holds and did not end; that it tried does not count."""
        held = [_TABLE.c.token == token, _TABLE.c.lease_owner == owner, _TABLE.c.state == AnalysisState.RUNNING]
        values = {"state": AnalysisState.QUEUED, "attempt": _TABLE.c.attempt - 1, **_FREE}
        self._session.execute(update(_TABLE).where(*held).values(values))

    def release_all(self, owner: str) -> None:
        """Put back what ``owner``, known to be dead, still holds."""
        held = [_TABLE.c.lease_owner == owner, _TABLE.c.state == AnalysisState.RUNNING]
        self._session.execute(update(_TABLE).where(*held).values(state=AnalysisState.QUEUED, **_FREE))

    def owners(self) -> set[str]:
        """Everyone who holds an analysis."""
        held = select(_TABLE.c.lease_owner).where(_TABLE.c.lease_owner.is_not(None)).distinct()
        return {str(owner) for owner in self._session.execute(held).scalars()}

    # -- what an analysis shows ------------------------------------------------------------------------------------

    def fingerprint(self, run_ids: Sequence[int]) -> str:
        """SHA-256 in hex over the states, current protocols and latest evaluations of runs.

        Figures of a run change with its state and its evaluations alone, so equal fingerprints mean equal figures.
        """
        digest = hashlib.sha256()
        runs, evaluations = Run.__table__, Evaluation.__table__
        for part in chunks(sorted(run_ids)):
            facts = select(runs.c.id, runs.c.state, runs.c.reason, runs.c.current_protocol_id)
            for row in self._session.execute(facts.where(runs.c.id.in_(part)).order_by(runs.c.id)):
                digest.update(repr(tuple(row)).encode())
            latest = select(evaluations.c.run_id, func.count(), func.max(evaluations.c.id)).where(
                evaluations.c.run_id.in_(part), evaluations.c.ended_at.is_not(None)
            )
            for row in self._session.execute(latest.group_by(evaluations.c.run_id).order_by(evaluations.c.run_id)):
                digest.update(repr(tuple(row)).encode())
        return digest.hexdigest()

    def _records(self, condition: ColumnElement[bool]) -> list[AnalysisRecord]:
        query = select(_TABLE).where(condition).order_by(_TABLE.c.id)
        return [_record(row) for row in self._session.execute(query)]


def _record(row: Row[Any]) -> AnalysisRecord:
    return AnalysisRecord(
        token=row.token,
        name=row.name,
        state=row.state,
        listed=row.listed,
        visitor=row.visitor,
        created_at=row.created_at,
        content_hash=row.content_hash,
        reason=row.reason,
        size_bytes=row.size_bytes,
        ended_at=row.ended_at,
        attempt=row.attempt,
        lease_owner=row.lease_owner,
    )
