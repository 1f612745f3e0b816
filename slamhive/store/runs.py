"""Runs: add, read, list, move from state to state, cancel."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from typing import Any, Unpack

from sqlalchemy import delete, func, insert, select, update

from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.domain.run import RunEvent, RunState, check_move
from slamhive.domain.trust import Disturbance
from slamhive.filters.binding import EVERYTHING, Search
from slamhive.store.changes import NewRow, changes_of
from slamhive.store.leases import NO_LEASE
from slamhive.store.metrics import VerdictRepository
from slamhive.store.models import (
    WHY_LENGTH,
    DeletedRunRow,
    EvaluationRow,
    MetricValueRow,
    RunEventRow,
    RunNoteRow,
    RunRow,
    RunTagRow,
)
from slamhive.store.records import LeaseLost, Page, RunFields, RunRecord, RunRequest, RunSnapshot, RunSort
from slamhive.store.rows import Repository, changed, chunks, cut, insert_many
from slamhive.store.run_cells import CellsWanted, RunCellPage, list_cells
from slamhive.store.run_listing import list_page, options_row, run_query, to_records
from slamhive.store.sharing import SharingRepository

_RUNS = RunRow.__table__
_DELETED = DeletedRunRow.__table__
_OF_RUNS = tuple(model.__table__ for model in (MetricValueRow, EvaluationRow, RunEventRow, RunNoteRow, RunTagRow))


@dataclass(frozen=True, slots=True)
class Deleted:
    """A run that was deleted: its uid, the number that it had, and when."""

    uid: str
    run_id: int
    at: datetime


class DeletedRunRepository(Repository):
    """Remembers the uids of deleted runs, so that an experiment or the ledger does not queue them again."""

    def remove(self, runs: Sequence[Deleted]) -> None:
        """Remove all rows of these runs. Runs that repeated them stay and repeat none; repeats are judged again."""
        ids = [run.run_id for run in runs]
        alike = self._repeats(ids)
        for part in chunks(ids):
            self._connection.execute(update(_RUNS).where(_RUNS.c.retry_of.in_(part)).values(retry_of=None))
            for table in _OF_RUNS:
                self._connection.execute(delete(table).where(table.c.run_id.in_(part)))
            self._connection.execute(delete(_RUNS).where(_RUNS.c.id.in_(part)))
        self.remember(runs)
        VerdictRepository(self._connection).renew(alike)

    def remember(self, runs: Sequence[Deleted]) -> None:
        """File that these runs were deleted, except those that are stored again."""
        uids = [run.uid for run in runs]
        known = set(self._known(_DELETED.c.uid, uids)) | set(self._known(_RUNS.c.uid, uids))
        new = [run for run in runs if run.uid not in known]
        if new:
            rows = [{"uid": run.uid, "run_id": run.run_id, "deleted_at": run.at} for run in new]
            self._connection.execute(insert(_DELETED), rows)

    def forget(self, uids: Sequence[str]) -> None:
        """These runs are stored again."""
        for part in chunks(uids):
            self._connection.execute(delete(_DELETED).where(_DELETED.c.uid.in_(part)))

    def among(self, uids: Sequence[str]) -> set[str]:
        """Those of these runs that were deleted."""
        return set(self._known(_DELETED.c.uid, uids))

    def repeated_by(self, run_ids: Sequence[int]) -> dict[int, list[int]]:
        """{run: the runs that repeat it}, without runs that none repeats."""
        found: dict[int, list[int]] = {}
        for part in chunks(run_ids):
            query = select(_RUNS.c.retry_of, _RUNS.c.id).where(_RUNS.c.retry_of.in_(part)).order_by(_RUNS.c.id)
            for run_id, repeat in self._connection.execute(query):
                found.setdefault(run_id, []).append(repeat)
        return found

    def by_configuration(self, run_ids: Sequence[int]) -> list[int]:
        """Those of these runs that exist, repeats beside each other: verdicts of repeats are renewed together."""
        placed: list[tuple[int, int]] = []
        for part in chunks(run_ids):
            query = select(_RUNS.c.configuration_id, _RUNS.c.id).where(_RUNS.c.id.in_(part))
            placed += [(configuration, run_id) for configuration, run_id in self._connection.execute(query)]
        return [run_id for _, run_id in sorted(placed)]

    def _known(self, column: object, uids: Sequence[str]) -> Iterable[str]:
        for part in chunks(uids):
            yield from self._column(select(column).where(column.in_(part)))  # type: ignore[attr-defined, call-overload]

    def _repeats(self, ids: Sequence[int]) -> list[int]:
        """The remaining runs of the configurations of these runs: verdicts depend on the repeats."""
        found: list[int] = []
        for part in chunks(ids):
            of = select(_RUNS.c.configuration_id).where(_RUNS.c.id.in_(part))
            found += self._column(select(_RUNS.c.id).where(_RUNS.c.configuration_id.in_(of)))
        return sorted(set(found) - set(ids))


DETAIL_LENGTH = 10_000
_EVENTS = RunEventRow.__table__
_AS_ASKED = tuple(entry.name for entry in fields(RunRequest) if entry.name in _RUNS.c and entry.name != "stop_when")
"""The fields of a request that are columns as they are."""


class RunRepository(Repository):
    """Checks every move against the table of legal moves, and writes it together with its event."""

    def add_runs(self, requests: Sequence[RunRequest], now: datetime, *, deleted_too: bool = True) -> list[int]:
        """Queue runs; their ids, in the order of ``requests``. A run whose ``uid`` is stored is not added again.

        ``deleted_too``: whether runs that were deleted are added again.
        """
        deleted = DeletedRunRepository(self._connection).among([request.uid for request in requests])
        if deleted and deleted_too:
            DeletedRunRepository(self._connection).forget(sorted(deleted))
        elif deleted:
            requests = [request for request in requests if request.uid not in deleted]
        known = self.ids_by_uid([request.uid for request in requests])
        new = [request for request in requests if request.uid not in known]
        if new:
            shared = SharingRepository(self._connection)
            new = shared.of_new_runs(new)
            audiences = shared.audiences(new)
            rows = [{**_new_row(request, now), "audience": audiences[request.uid]} for request in new]
            insert_many(self._connection, _RUNS, tuple(rows[0]), [tuple(row.values()) for row in rows])
            known.update(self.ids_by_uid([request.uid for request in new]))
            events = [event_row(known[request.uid], queued_event(request, now)) for request in new]
            insert_many(self._connection, _EVENTS, tuple(events[0]), [tuple(event.values()) for event in events])
            changes_of(self._connection).runs += [NewRow(known[request.uid], request, now) for request in new]
        return [known[request.uid] for request in requests]

    def get(self, run_id: int, *, with_metrics: bool = False) -> RunRecord:
        """The run with this id; raises NotFound."""
        return self.get_many([run_id], with_metrics=with_metrics)[0]

    def get_many(self, run_ids: Iterable[int], *, with_metrics: bool = False) -> tuple[RunRecord, ...]:
        """The runs with these ids, in this order; raises NotFound for the first that does not exist."""
        wanted = list(run_ids)
        found: dict[int, RunRecord] = {}
        for part in chunks(sorted(set(wanted))):
            rows = self._connection.execute(run_query().where(RunRow.id.in_(part))).all()
            found.update(
                (record.id, record) for record in to_records(self._connection, rows, with_metrics=with_metrics)
            )
        for run_id in wanted:
            if run_id not in found:
                raise NotFound(f"unknown run {run_id}", "slamhive runs lists them")
        return tuple(found[run_id] for run_id in wanted)

    def page(
        self,
        wanted: Search | None = None,
        sort: RunSort | None = None,
        after: str | None = None,
        limit: int = 50,
        *,
        with_metrics: bool = False,
    ) -> Page:
        """One page of runs with their parameters. The number of queries does not depend on the length of the page.

        Args:
            wanted: Which runs, and the protocol of their metrics.
            sort: The order; None is newest first.
            after: ``next_key`` of the previous page; None is the first page. Raises InvalidInput for another text.
            limit: Most runs of the page, 1 to 1000.
            with_metrics: Fill ``RunRecord.metrics``.
        """
        search = wanted or EVERYTHING
        return list_page(self._connection, search, sort or RunSort(), after, limit, with_metrics=with_metrics)

    def cells(
        self, wanted: Search | None, sort: RunSort, after: str | None, limit: int, columns: CellsWanted
    ) -> RunCellPage:
        """Like :meth:`page`, for exports: only what ``columns`` read, and pages of any length."""
        return list_cells(self._connection, wanted or EVERYTHING, sort, after, limit, columns)

    def active(self) -> tuple[RunRecord, ...]:
        """The runs that workers have claimed, in order; there are at most as many as slots."""
        states = tuple(state for state in RunState if state.active)
        return self.get_many(
            self._connection.scalars(select(RunRow.id).where(RunRow.state.in_(states)).order_by(RunRow.id))
        )

    def counts_by_state(self) -> dict[RunState, int]:
        """The number of runs in each state, 0 included."""
        rows = self._connection.execute(select(_RUNS.c.state, func.count()).group_by(_RUNS.c.state))
        found = {row[0]: row[1] for row in rows}
        return {state: found.get(state, 0) for state in RunState}

    def events(self, run_id: int) -> list[RunEvent]:
        """The moves of one run, oldest first."""
        rows = self._connection.execute(select(_EVENTS).where(_EVENTS.c.run_id == run_id).order_by(_EVENTS.c.id))
        return [RunEvent(row.at, row.from_state, row.to_state, row.why) for row in rows]

    def move(
        self,
        run_id: int,
        target: RunState,
        *,
        why: str,
        now: datetime,
        owner: str | None = None,
        **fields: Unpack[RunFields],
    ) -> RunState:
        """Move a run, and write ``fields`` and the event; returns the state before the move.

        A move to ``running`` sets ``started_at`` and an end sets ``ended_at`` to ``now``, unless they have a value. An
        end, or a move back to ``queued``, gives up the lease. Repeating a move with the same ``now`` does nothing,
        since the answer to the first may have been lost.

        Args:
            run_id: The run.
            target: The new state; raises Conflict if the table of legal moves does not allow it.
            why: For the event, one line.
            now: When.
            owner: The worker that must hold the lease, else LeaseLost; None moves the run whoever holds it.
            fields: Columns to write, see :class:`RunFields`. ``failed`` needs a ``reason``.
        """
        row = self._current(run_id)
        if row.state is target and self._is_repeated(run_id, target, now):
            return RunState(row.state)
        if owner is not None and row.lease_owner != owner:
            raise LeaseLost(f"run {run_id} is held by {row.lease_owner or 'nobody'}, not by {owner}")
        check_move(run_id, row.state, target)
        if target is RunState.FAILED and fields.get("reason") is None:
            raise InvalidInput(f"run {run_id} cannot fail without a reason")
        values = {**_defaults(row, target, now), **_checked(fields), "state": target}
        # Compare and set: the move was checked against a state that another process may have changed since.
        condition = [_RUNS.c.id == run_id, _RUNS.c.state == row.state]
        if owner is not None:
            condition.append(_RUNS.c.lease_owner == owner)
        if changed(self._connection, update(_RUNS).where(*condition).values(values)) != 1:
            raise LeaseLost(f"run {run_id} was changed by another process while it moved to {target}")
        self._connection.execute(insert(_EVENTS).values(event_row(run_id, RunEvent(now, row.state, target, why))))
        if row.state is RunState.QUEUED and target is RunState.CANCELLED:
            changes_of(self._connection).cancelled.append(([run_id], now, why))
        return RunState(row.state)

    def update(self, run_id: int, owner: str | None = None, **fields: Unpack[RunFields]) -> None:
        """Write ``fields`` without a move; raises LeaseLost as ``move`` does."""
        condition = [_RUNS.c.id == run_id]
        if owner is not None:
            condition.append(_RUNS.c.lease_owner == owner)
        if changed(self._connection, update(_RUNS).where(*condition).values(_checked(fields))) != 1:
            row = self._current(run_id)
            raise LeaseLost(f"run {run_id} is held by {row.lease_owner or 'nobody'}, not by {owner}")

    def request_cancel(self, run_id: int, now: datetime, why: str = "cancelled by the user") -> RunState:
        """Cancel a queued run at once, or ask the worker of an active one to end it; the state of the run now.

        Raises Conflict if the run has ended.
        """
        while True:  # a worker may claim the run, or end it, between the look and the change
            state = RunState(self._current(run_id).state)
            if state is RunState.CANCELLED and self._is_repeated(run_id, state, now):
                return state
            if state.ended:
                raise Conflict(f"run {run_id} has ended already, it is {state}")
            if state.active:
                flag = update(_RUNS).where(_RUNS.c.id == run_id, _RUNS.c.state == state).values(cancel_requested=True)
                if changed(self._connection, flag) == 1:
                    changes_of(self._connection).asked_to_end.add(run_id)
                    return state
                continue
            try:
                self.move(run_id, RunState.CANCELLED, why=why, now=now)
            except LeaseLost:
                continue
            return RunState.CANCELLED

    def ids_by_uid(self, uids: Sequence[str]) -> dict[str, int]:
        """{uid: number} of those of these runs that are stored."""
        found: dict[str, int] = {}
        for part in chunks(uids):
            for row in self._connection.execute(select(_RUNS.c.uid, _RUNS.c.id).where(_RUNS.c.uid.in_(part))):
                found[row.uid] = row.id
        return found

    def _current(self, run_id: int) -> Any:
        columns = (_RUNS.c.state, _RUNS.c.lease_owner, _RUNS.c.started_at, _RUNS.c.ended_at)
        row = self._connection.execute(select(*columns).where(_RUNS.c.id == run_id)).one_or_none()
        if row is None:
            raise NotFound(f"unknown run {run_id}", "slamhive runs lists them")
        return row

    def _is_repeated(self, run_id: int, target: RunState, now: datetime) -> bool:
        latest = select(_EVENTS).where(_EVENTS.c.run_id == run_id).order_by(_EVENTS.c.id.desc()).limit(1)
        event = self._connection.execute(latest).one_or_none()
        return event is not None and event.to_state is target and event.at == now


def queued_event(request: RunRequest, at: datetime) -> RunEvent:
    """The first move of a run."""
    why = f"retry of run {request.retry_of}" if request.retry_of else "submitted"
    return RunEvent(at, None, RunState.QUEUED, why)


def event_row(run_id: int, event: RunEvent) -> dict[str, Any]:
    """The columns of a move."""
    why = cut(" ".join(event.why.split()), WHY_LENGTH)
    return {"run_id": run_id, "at": event.at, "from_state": event.from_state, "to_state": event.to_state, "why": why}


def snapshot_row(snapshot: RunSnapshot) -> dict[str, Any]:
    """The columns, except the id, of a run that is known completely."""
    return {
        **_new_row(snapshot.request, snapshot.created_at),
        **_checked(snapshot.fields),
        "state": snapshot.state,
        "attempt": snapshot.attempt,
    }


def _new_row(request: RunRequest, now: datetime) -> dict[str, Any]:
    values = {name: getattr(request, name) for name in _AS_ASKED}
    values["protocol_override"] = None if request.protocol is None else request.protocol.content
    values |= options_row(request)
    return {**values, "state": RunState.QUEUED, "created_at": now, "attempt": 0, "cancel_requested": False}


def _checked(fields: RunFields) -> dict[str, Any]:
    """The fields as columns. A long detail is cut; disturbance has a second column for searches."""
    values: dict[str, Any] = dict(fields)
    if "detail" in values:
        values["detail"] = cut(values["detail"], DETAIL_LENGTH)
    if "disturbance" in values:
        found: Disturbance | None = values["disturbance"]
        known = found is not None and found.known
        values["disturbance"] = None if found is None else found.content
        values["disturbed_by"] = " ".join(reason.kind for reason in found.reasons) if found and known else None
    return values


def _defaults(row: Any, target: RunState, now: datetime) -> dict[str, Any]:
    """The columns that a move writes besides its fields."""
    if target is RunState.RUNNING and row.started_at is None:
        return {"started_at": now}
    if target is RunState.QUEUED:
        return {**NO_LEASE, "handle": None}
    if target.ended:
        ended = {"ended_at": now} if row.ended_at is None else {}
        return {**ended, **NO_LEASE}
    return {}
