"""Analyses: their list and their queue."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

from sqlalchemy import ColumnElement, Row, delete, func, insert, select, true, update

from slamhive.base.errors import NotFound
from slamhive.store.changes import changes_of
from slamhive.store.leases import NO_LEASE, Lease, LeaseQueue
from slamhive.store.models import AnalysisRow, EvaluationRow, RunRow
from slamhive.store.records import AnalysisRecord, AnalysisState, LeaseLost
from slamhive.store.rows import changed, chunks, cut
from slamhive.store.sharing import sharing_columns

REASON_LENGTH = 10_000
_TABLE = AnalysisRow.__table__


class AnalysisRepository(LeaseQueue[str]):
    """One worker computes an analysis at a time; if it dies, the next one takes over."""

    table = _TABLE
    key = "token"
    queued = AnalysisState.QUEUED
    working = (AnalysisState.RUNNING,)
    released = AnalysisState.QUEUED
    refunds_attempts = True

    def put(self, record: AnalysisRecord) -> None:
        """File an analysis as its folder describes it; a worker that computes it loses it. May be repeated."""
        changes_of(self._connection).started.add(f"analysis {record.name}")
        values = {
            "name": record.name,
            "listed": record.listed,
            "visitor": record.visitor,
            "created_at": record.created_at,
            **_ending(record),
            "attempt": 0,
            **NO_LEASE,
            **sharing_columns(record.sharing),
        }
        if not changed(self._connection, update(_TABLE).where(_TABLE.c.token == record.token).values(values)):
            self._connection.execute(insert(_TABLE).values(token=record.token, **values))

    def get(self, token: str) -> AnalysisRecord:
        """The analysis at this address; raises NotFound."""
        found = self._records(_TABLE.c.token == token)
        if not found:
            raise NotFound("there is no analysis at this address", "it may have been deleted")
        return found[0]

    def listed(self, limit: int) -> list[AnalysisRecord]:
        """The analyses that the list shows, newest first."""
        query = select(_TABLE).where(_TABLE.c.listed == True).order_by(_TABLE.c.id.desc()).limit(limit)  # noqa: E712
        return [_record(row) for row in self._connection.execute(query)]

    def all(self) -> list[AnalysisRecord]:
        """All analyses, oldest first."""
        return self._records(true())

    def visitors(self) -> list[AnalysisRecord]:
        """The analyses that visitors made in view-only mode, oldest first."""
        return self._records(_TABLE.c.visitor == True)  # noqa: E712

    def waiting(self) -> int:
        """The number of analyses that are not computed yet."""
        open_ones = _TABLE.c.state.in_((AnalysisState.QUEUED, AnalysisState.RUNNING))
        return self._number(select(func.count()).select_from(_TABLE).where(open_ones))

    def same(self, content_hash: str) -> list[str]:
        """The addresses of finished analyses with the same content, newest first."""
        query = select(_TABLE.c.token).where(
            _TABLE.c.content_hash == content_hash, _TABLE.c.state == AnalysisState.DONE
        )
        return self._column(query.order_by(_TABLE.c.id.desc()))

    def list_or_not(self, token: str, *, listed: bool) -> None:
        """Show it in the list, or at its address only. Raises NotFound."""
        self.get(token)
        self._connection.execute(update(_TABLE).where(_TABLE.c.token == token).values(listed=listed))

    def delete(self, token: str) -> bool:
        """Delete it; whether it existed. A worker that computes it learns of it with its next heartbeat."""
        return changed(self._connection, delete(_TABLE).where(_TABLE.c.token == token)) == 1

    # -- the queue -------------------------------------------------------------------------------------------------

    def claim(self, lease: Lease) -> AnalysisRecord | None:
        """Take the oldest analysis that waits or whose worker went silent; None if there is none."""
        taken = self._take_oldest(self._waiting(lease.now), lease, 1, state=AnalysisState.RUNNING)
        return self._records(_TABLE.c.token == taken[0])[0] if taken else None

    def finish(self, record: AnalysisRecord, owner: str) -> None:
        """File the end of an analysis that ``owner`` computes; raises LeaseLost if it no longer holds it."""
        if not self._end(record.token, owner, **_ending(record)):
            raise LeaseLost(f"analysis {record.token} was deleted, or taken over by another worker")

    # -- what an analysis shows ------------------------------------------------------------------------------------

    def fingerprint(self, run_ids: Sequence[int]) -> str:
        """SHA-256 in hex over the states, current protocols and latest evaluations of runs.

        The metrics of a run change only with its state and its evaluations: equal fingerprints mean equal metrics.
        """
        digest = hashlib.sha256()
        runs, evaluations = RunRow.__table__, EvaluationRow.__table__
        for part in chunks(sorted(run_ids)):
            facts = select(runs.c.id, runs.c.state, runs.c.reason, runs.c.current_protocol_id)
            for row in self._connection.execute(facts.where(runs.c.id.in_(part)).order_by(runs.c.id)):
                digest.update(repr(tuple(row)).encode())
            latest = select(evaluations.c.run_id, func.count(), func.max(evaluations.c.id)).where(
                evaluations.c.run_id.in_(part), evaluations.c.ended_at.is_not(None)
            )
            for row in self._connection.execute(latest.group_by(evaluations.c.run_id).order_by(evaluations.c.run_id)):
                digest.update(repr(tuple(row)).encode())
        return digest.hexdigest()

    def _records(self, condition: ColumnElement[bool]) -> list[AnalysisRecord]:
        query = select(_TABLE).where(condition).order_by(_TABLE.c.id)
        return [_record(row) for row in self._connection.execute(query)]


def _ending(record: AnalysisRecord) -> dict[str, Any]:
    return {
        "state": record.state,
        "content_hash": record.content_hash,
        "reason": cut(record.reason, REASON_LENGTH),
        "size_bytes": record.size_bytes,
        "ended_at": record.ended_at,
    }


def _record(row: Row[Any]) -> AnalysisRecord:
    return AnalysisRecord(**{name: getattr(row, name) for name in AnalysisRecord.__dataclass_fields__})
