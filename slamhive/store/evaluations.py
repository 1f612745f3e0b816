"""Evaluations and their queue. However an evaluation ends, its run and other evaluations do not change."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, Row, Select, exists, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from slamhive.base.errors import Conflict, NotFound
from slamhive.domain import protocol as domain
from slamhive.domain.run import RunState
from slamhive.domain.side_by_side import MixedProtocols, ProtocolUse, mixed_protocols
from slamhive.evaluation.job import Artefacts, EvaluationResult
from slamhive.store.catalogue import CatalogueRepository
from slamhive.store.changes import AskedEvaluations, changes_of
from slamhive.store.leases import Lease, LeaseQueue
from slamhive.store.metrics import MetricRepository, VerdictRepository
from slamhive.store.models import MEASURED_PROTOCOL_ID, EvaluationRow, ProtocolRow, RunRow
from slamhive.store.records import EvaluationRecord, EvaluationState, LeaseLost
from slamhive.store.rows import changed, chunks, cut, get_or_insert

REASON_LENGTH = 10_000
_TABLE = EvaluationRow.__table__
_OPEN = (EvaluationState.QUEUED, EvaluationState.RUNNING)


class EvaluationRepository(LeaseQueue[int]):
    """Evaluating again adds a row. For each run and protocol, at most one evaluation waits or works at a time."""

    table = _TABLE
    queued = EvaluationState.QUEUED
    working = (EvaluationState.RUNNING,)
    released = EvaluationState.QUEUED

    def queue(
        self,
        run_ids: Iterable[int],
        protocol: domain.Protocol,
        now: datetime,
        artefacts: Artefacts = Artefacts.FILES,
        *,
        makes_current: bool = False,
    ) -> list[int]:
        """Queue an evaluation for each run, unless one waits or works already; their ids, in the order of the runs.

        ``makes_current``: their success makes the protocol the current one, also of those that wait already.
        Raises NotFound for an unknown run and Conflict for one that did not succeed.
        """
        wanted = list(run_ids)
        states: dict[int, RunState] = {}
        for part in chunks(wanted):
            rows = self._connection.execute(select(RunRow.id, RunRow.state).where(RunRow.id.in_(part)))
            states.update((row.id, row.state) for row in rows)
        for run_id in wanted:
            if run_id not in states:
                raise NotFound(f"unknown run {run_id}", "slamhive runs lists them")
            if states[run_id] is not RunState.SUCCEEDED:
                raise Conflict(f"run {run_id} is {states[run_id]}", "only a run that succeeded can be evaluated")
        protocol_id = CatalogueRepository(self._connection).put_protocol(protocol)
        values = {
            "state": EvaluationState.QUEUED,
            "artefacts": artefacts,
            "created_at": now,
            "attempt": 0,
            "makes_current": makes_current,
        }
        keys = {"protocol_id": protocol_id, "open": 1}
        ids: dict[int, int] = {}
        for part in chunks(list(dict.fromkeys(wanted))):
            ids.update(self._open_ids(part, protocol_id))
            new = [{"run_id": run_id, **keys, **values} for run_id in part if run_id not in ids]
            try:
                if new:
                    self._connection.execute(insert(_TABLE), new)
                ids.update(self._open_ids(part, protocol_id))
            except IntegrityError:  # another process queues the same at the same time
                for run_id in part:
                    ids[run_id] = get_or_insert(self._connection, EvaluationRow, {"run_id": run_id, **keys}, values)[0]
        if makes_current:
            for part in chunks(list(ids.values())):
                self._connection.execute(update(_TABLE).where(_TABLE.c.id.in_(part)).values(makes_current=True))
        asked = AskedEvaluations(protocol, artefacts, now, list(ids), makes_current)
        changes_of(self._connection).asked_evaluations.append(asked)
        return [ids[run_id] for run_id in wanted]

    def _open_ids(self, run_ids: Sequence[int], protocol_id: int) -> dict[int, int]:
        query = select(_TABLE.c.run_id, _TABLE.c.id).where(
            _TABLE.c.run_id.in_(run_ids), _TABLE.c.protocol_id == protocol_id, _TABLE.c.open == 1
        )
        return {row.run_id: row.id for row in self._connection.execute(query)}

    def claim(self, lease: Lease, limit: int = 100, runs: Collection[int] | None = None) -> list[EvaluationRecord]:
        """Take up to ``limit`` evaluations, oldest first: queued ones, and those whose worker went silent.

        ``runs`` restricts the choice to evaluations of these runs.
        """
        free = self._waiting(lease.now)
        if runs is not None:
            free &= _TABLE.c.run_id.in_(sorted(runs))
        taken = self._take_oldest(free, lease, limit, state=EvaluationState.RUNNING, started_at=lease.at)
        return self._records(_TABLE.c.id.in_(taken))

    def finish(self, evaluation_id: int, owner: str, result: EvaluationResult, now: datetime) -> bool:
        """File the result; a success stores the metrics. The run and its repeats get new verdicts.

        Returns whether the protocol has become the run's current one: that of its first success, until :meth:`use` or
        an evaluation that ``makes_current`` chooses another. May be repeated. Raises LeaseLost if another worker holds
        the evaluation now.
        """
        row = self._connection.execute(select(_TABLE).where(_TABLE.c.id == evaluation_id)).one_or_none()
        if row is None:
            raise NotFound(f"unknown evaluation {evaluation_id}")
        if row.ended_at == now and row.open is None:
            return False
        if not self._end(evaluation_id, owner, **_ending(result, now)):
            raise LeaseLost(f"evaluation {evaluation_id} is {row.state}, held by {row.lease_owner or 'nobody'}")
        became_current = False
        if result.succeeded:
            MetricRepository(self._connection).replace(row.run_id, result.fingerprint, result.metrics)
            runs, protocols = RunRow.__table__, ProtocolRow.__table__
            query = select(protocols.c.definition, runs.c.protocol_override).select_from(
                protocols.join(runs, runs.c.id == row.run_id)
            )
            definition, asked = self._connection.execute(query.where(protocols.c.id == row.protocol_id)).one()
            chosen = update(runs).where(runs.c.id == row.run_id)
            if row.makes_current:
                self._connection.execute(chosen.values(current_protocol_id=row.protocol_id))
                became_current = True
            # A protocol of another trajectory than ``traj.txt`` comes beside the run's own, and would change what lists
            # show of the run. It counts if the run was submitted with it.
            elif "trajectory" not in definition or definition == asked:
                first = chosen.where(runs.c.current_protocol_id.is_(None))
                became_current = changed(self._connection, first.values(current_protocol_id=row.protocol_id)) == 1
            MetricRepository(self._connection).follow_protocols([row.run_id])
        VerdictRepository(self._connection).renew([row.run_id], row.protocol_id)
        changes_of(self._connection).evaluated.add(evaluation_id)
        return became_current

    def use(self, run_ids: Iterable[int], fingerprint: str) -> None:
        """Make a protocol the current one of these runs: lists, searches and pages show its metrics.

        Raises NotFound for an unknown protocol or run, Conflict for a run without metrics under it.
        """
        protocol_id = self._connection.execute(
            select(ProtocolRow.id).where(ProtocolRow.fingerprint == fingerprint, ProtocolRow.id != MEASURED_PROTOCOL_ID)
        ).scalar_one_or_none()
        if protocol_id is None:
            raise NotFound(f"unknown protocol {fingerprint!r}", "slamhive protocol list shows them")
        wanted = list(dict.fromkeys(run_ids))
        for part in chunks(wanted):
            done = select(_TABLE.c.run_id).where(
                _TABLE.c.run_id.in_(part),
                _TABLE.c.protocol_id == protocol_id,
                _TABLE.c.state == EvaluationState.SUCCEEDED,
            )
            found = set(self._column(done))
            lacking = next((run_id for run_id in part if run_id not in found), None)
            if lacking is not None:
                raise Conflict(f"run {lacking} has no metrics under protocol {fingerprint}", "evaluate it first")
            runs = RunRow.__table__
            self._connection.execute(update(runs).where(runs.c.id.in_(part)).values(current_protocol_id=protocol_id))
            MetricRepository(self._connection).follow_protocols(part)

    def protocols(self) -> list[tuple[domain.Protocol, int]]:
        """The protocols with metrics, and how many runs each has; the most used first."""
        count = func.count(_TABLE.c.run_id.distinct())
        query = (
            select(ProtocolRow.definition, count)
            .join(_TABLE, _TABLE.c.protocol_id == ProtocolRow.id)
            .where(_TABLE.c.state == EvaluationState.SUCCEEDED)
            .group_by(ProtocolRow.id)
            .order_by(count.desc(), ProtocolRow.id)
        )
        rows = self._connection.execute(query)
        return [(domain.protocol_from_content(definition), runs) for definition, runs in rows]

    def uses(self, run_ids: Iterable[int]) -> list[ProtocolUse]:
        """The protocols and trajectories behind the current errors of these runs, without those that have none."""
        return self._uses([RunRow.id.in_(part) for part in chunks(list(run_ids))])

    def _uses(self, parts: Iterable[ColumnElement[bool]]) -> list[ProtocolUse]:
        runs, protocols = RunRow.__table__, ProtocolRow.__table__
        found: Counter[ProtocolUse] = Counter()
        for part in parts:
            # Counted by number before the labels are joined: a large experiment is read once, with nothing to look up.
            counts = (
                select(runs.c.current_protocol_id, runs.c.trajectory, func.count().label("number"))
                .where(part, runs.c.current_protocol_id.is_not(None))
                .group_by(runs.c.current_protocol_id, runs.c.trajectory)
                .subquery()
            )
            query = select(protocols.c.fingerprint, protocols.c.label, counts.c.trajectory, counts.c.number).join(
                counts, counts.c.current_protocol_id == protocols.c.id
            )
            for fingerprint, label, trajectory, count in self._connection.execute(query):
                found[ProtocolUse(fingerprint, label, trajectory, 0)] += count
        return [replace(use, runs=count) for use, count in found.items()]

    def mixed_of(self, run_ids: Iterable[int]) -> MixedProtocols | None:
        """The protocols of these runs if they are not comparable, with the one that all of them can have."""
        parts = [RunRow.id.in_(part) for part in chunks(list(run_ids))]
        return self._mixed(self._uses(parts), parts)

    def mixed_in(self, experiment_id: int) -> MixedProtocols | None:
        """The same for all runs of an experiment, however many: no ids are read."""
        runs = [RunRow.experiment_id == experiment_id]
        return self._mixed(self._uses(runs), runs)

    def mixed(self, uses: Iterable[ProtocolUse]) -> MixedProtocols | None:
        """The same for runs whose protocols are known, without a look at what was tried in vain."""
        return self._mixed(uses, ())

    def _mixed(self, uses: Iterable[ProtocolUse], parts: Iterable[ColumnElement[bool]]) -> MixedProtocols | None:
        """``parts`` are the conditions of the runs, which tell which protocols were tried in vain."""
        found = list(uses)
        mixed = mixed_protocols(found)
        if mixed is None:
            return None
        definitions = self.definitions({use.fingerprint for use in found})
        kinds = (
            replace(protocol, trajectory=kind).fingerprint
            for protocol in definitions.values()
            for kind in domain.TrajectoryKind
        )
        definitions |= self.definitions(set(kinds))
        return mixed_protocols(found, definitions, self._refused(parts, definitions))

    def _refused(self, parts: Iterable[ColumnElement[bool]], fingerprints: Collection[str]) -> dict[str, int]:
        """{fingerprint: number of these runs whose evaluations under it all failed}."""
        failed: dict[str, set[int]] = {}
        for part in parts:
            query = (
                select(ProtocolRow.fingerprint, _TABLE.c.run_id)
                .join(_TABLE, _TABLE.c.protocol_id == ProtocolRow.id)
                .join(RunRow, RunRow.id == _TABLE.c.run_id)
                .where(part, _TABLE.c.state == EvaluationState.FAILED)
                .where(ProtocolRow.fingerprint.in_(sorted(fingerprints)))
            )
            for fingerprint, run_id in self._connection.execute(query):
                failed.setdefault(fingerprint, set()).add(run_id)
        left = {fingerprint: runs - self.having(runs, fingerprint) for fingerprint, runs in failed.items()}
        return {fingerprint: len(runs) for fingerprint, runs in left.items() if runs}

    def definitions(self, fingerprints: Collection[str]) -> dict[str, domain.Protocol]:
        """{fingerprint: protocol}; unknown ones are left out."""
        query = select(ProtocolRow.fingerprint, ProtocolRow.definition).where(
            ProtocolRow.fingerprint.in_(sorted(fingerprints)), ProtocolRow.id != MEASURED_PROTOCOL_ID
        )
        rows = self._connection.execute(query)
        return {fingerprint: domain.protocol_from_content(definition) for fingerprint, definition in rows}

    def having(self, run_ids: Iterable[int], fingerprint: str) -> set[int]:
        """Those of these runs with metrics under a protocol."""
        found: set[int] = set()
        for part in chunks(list(run_ids)):
            query = (
                select(_TABLE.c.run_id)
                .join(ProtocolRow, ProtocolRow.id == _TABLE.c.protocol_id)
                .where(_TABLE.c.run_id.in_(part), _TABLE.c.state == EvaluationState.SUCCEEDED)
                .where(ProtocolRow.fingerprint == fingerprint)
            )
            found.update(self._column(query))
        return found

    def unevaluated_run_ids(self) -> list[int]:
        """Runs that succeeded and have no successful, queued or running evaluation; oldest first."""
        settled = exists().where(_TABLE.c.run_id == RunRow.id, _TABLE.c.state.in_((*_OPEN, EvaluationState.SUCCEEDED)))
        query = select(RunRow.id).where(RunRow.state == RunState.SUCCEEDED, ~settled).order_by(RunRow.id)
        return self._column(query)

    def open(self) -> list[EvaluationRecord]:
        """All evaluations that are queued or running, oldest first."""
        return self._records(_TABLE.c.open == 1)

    def standing(self) -> tuple[int, int]:
        """The number of evaluations that are queued or running, and the highest id of all; 0 without any.

        Both together change whenever an evaluation is queued or ends.
        """
        latest = select(func.coalesce(func.max(_TABLE.c.id), 0))
        return self._number(select(func.count()).where(_TABLE.c.state.in_(_OPEN))), self._number(latest)

    def still_open(self, evaluation_ids: Iterable[int]) -> set[int]:
        """Those of these evaluations that have not ended."""
        found: set[int] = set()
        for part in chunks(list(evaluation_ids)):
            query = select(_TABLE.c.id).where(_TABLE.c.id.in_(part), _TABLE.c.open == 1)
            found.update(self._column(query))
        return found

    def unsettled_among(self, run_ids: Iterable[int]) -> list[int]:
        """Those of these runs that have no successful evaluation, in the given order."""
        wanted = list(run_ids)
        settled: set[int] = set()
        for part in chunks(wanted):
            query = select(_TABLE.c.run_id).where(
                _TABLE.c.run_id.in_(part), _TABLE.c.state == EvaluationState.SUCCEEDED
            )
            settled.update(self._column(query))
        return [run_id for run_id in wanted if run_id not in settled]

    def counts_by_state(self) -> dict[EvaluationState, int]:
        """The number of evaluations in each state, 0 included."""
        states = self._connection.execute(select(_TABLE.c.state, func.count()).group_by(_TABLE.c.state)).all()
        found = {row[0]: row[1] for row in states}
        return {state: found.get(state, 0) for state in EvaluationState}

    def get(self, evaluation_id: int) -> EvaluationRecord:
        """The evaluation with this id; raises NotFound."""
        return self.get_many([evaluation_id])[0]

    def get_many(self, evaluation_ids: Iterable[int]) -> list[EvaluationRecord]:
        """The evaluations with these ids, in this order; raises NotFound naming the first that is not there."""
        wanted = list(evaluation_ids)
        found: dict[int, EvaluationRecord] = {}
        for part in chunks(wanted):
            found.update((record.id, record) for record in self._records(_TABLE.c.id.in_(part)))
        for evaluation_id in wanted:
            if evaluation_id not in found:
                raise NotFound(f"unknown evaluation {evaluation_id}")
        return [found[evaluation_id] for evaluation_id in wanted]

    def for_run(self, run_id: int) -> list[EvaluationRecord]:
        """All evaluations of one run, oldest first."""
        return self._records(_TABLE.c.run_id == run_id)

    def with_open(self, run_ids: Sequence[int]) -> set[int]:
        """Those of these runs with an evaluation that has not ended."""
        found: set[int] = set()
        for part in chunks(run_ids):
            query = select(_TABLE.c.run_id).where(_TABLE.c.run_id.in_(part), _TABLE.c.open.is_not(None))
            found.update(self._column(query))
        return found

    def _records(self, condition: ColumnElement[bool]) -> list[EvaluationRecord]:
        rows = self._connection.execute(_query().where(condition).order_by(_TABLE.c.id)).all()
        return [_record(row) for row in rows]


def _query() -> Select[Any]:
    return select(_TABLE, ProtocolRow.definition).join(ProtocolRow, ProtocolRow.id == _TABLE.c.protocol_id)


def _record(row: Row[Any]) -> EvaluationRecord:
    values = {name: getattr(row, name) for name in EvaluationRecord.__dataclass_fields__ if name != "protocol"}
    return EvaluationRecord(protocol=domain.protocol_from_content(row.definition), **values)


def _ending(result: EvaluationResult, now: datetime) -> dict[str, Any]:
    return {
        "state": EvaluationState.SUCCEEDED if result.succeeded else EvaluationState.FAILED,
        "open": None,
        "reason": cut(result.reason, REASON_LENGTH),
        "engine": cut(result.engine, 190),
        "ended_at": now,
    }
