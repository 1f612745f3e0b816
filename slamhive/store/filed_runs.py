"""Files runs as their folders describe them, many runs in a few statements; for reindexing and archives."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import groupby
from typing import Any

from sqlalchemy import bindparam, delete, insert, or_, select, update

from slamhive.base.errors import Conflict
from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.protocol import Protocol, TrajectoryKind
from slamhive.domain.run import NO_NOTES, RunNotes, RunState
from slamhive.store.catalogue import CatalogueRepository, NoteRepository
from slamhive.store.changes import changes_of
from slamhive.store.evaluations import REASON_LENGTH
from slamhive.store.metrics import MetricRepository, VerdictRepository
from slamhive.store.models import MEASURED_PROTOCOL_ID, EvaluationRow, MetricValueRow, RunEventRow, RunRow
from slamhive.store.records import EndedEvaluation, RunRequest, RunSnapshot
from slamhive.store.rows import Repository, chunks, cut
from slamhive.store.runs import DeletedRunRepository, RunRepository, event_row, snapshot_row
from slamhive.store.sharing import SharingRepository

_RUNS = RunRow.__table__
_EVENTS = RunEventRow.__table__
_EVALUATIONS = EvaluationRow.__table__
_FIGURES = MetricValueRow.__table__
_ENGINE_LENGTH = 190
_SHARED = ("owner", "visibility", "audience")


AS_FILED = tuple(name for name in EndedEvaluation.__dataclass_fields__ if name != "protocol")


@dataclass(frozen=True, slots=True)
class FiledRun:
    """A run with everything that is filed of it.

    ``measured``: {metric key: value}. ``evaluations``: oldest first. ``figures``: {fingerprint of one of their
    protocols: {metric key: value}}. ``current``: the protocol whose metrics are shown, None to leave that as it is.
    ``notes``: what the folder says that somebody wrote. ``shared``: whether the request states owner and visibility; if
    not, those of a row that exists stay as they are.
    """

    snapshot: RunSnapshot
    measured: Mapping[str, float] = field(default_factory=dict)
    evaluations: Sequence[EndedEvaluation] = ()
    figures: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    current: str | None = None
    notes: RunNotes = NO_NOTES
    shared: bool = True


class FiledRunRepository(Repository):
    """Files runs that are known completely: it updates rows that exist and adds those that do not."""

    def file(self, runs: Sequence[FiledRun]) -> dict[int, int]:
        """File at most some hundreds of runs; their metrics must be finite.

        Returns {number: number of the original} of the runs that repeat a run that is not stored. They are filed as if
        they repeated none.
        Raises Conflict, having written nothing, if a number or uid belongs to another run.
        """
        snapshots = [run.snapshot for run in runs]
        uids = {snapshot.id: snapshot.request.uid for snapshot in snapshots}
        same = _RUNS.c.id.in_(uids) | _RUNS.c.uid.in_(uids.values())
        found = {row.uid: row.id for row in self._connection.execute(select(_RUNS.c.uid, _RUNS.c.id).where(same))}
        by_number = {number: uid for uid, number in found.items()}
        claimed: set[str] = set()
        for number, uid in uids.items():
            other = by_number.get(number, uid), found.get(uid, number)
            if other != (uid, number) or uid in claimed:
                raise Conflict(
                    f"run {number} (uid {uid}) clashes with run {other[1]} (uid {other[0]})",
                    "two folders cannot hold the same run",
                )
            claimed.add(uid)
        here = set(found.values())
        catalogue = CatalogueRepository(self._connection)
        protocols = {entry.protocol.fingerprint: entry.protocol for run in runs for entry in run.evaluations}
        numbers = {fingerprint: catalogue.put_protocol(protocol) for fingerprint, protocol in protocols.items()}
        left = self._put_rows(runs, here, numbers)
        if here:
            self._connection.execute(delete(_EVENTS).where(_EVENTS.c.run_id.in_(here)))
        events = [event_row(run.snapshot.id, event) for run in runs for event in run.snapshot.events]
        if events:
            self._connection.execute(insert(_EVENTS), events)
        # Those that are not stored yet: one for each run, protocol and state.
        columns = (_EVALUATIONS.c.run_id, _EVALUATIONS.c.protocol_id, _EVALUATIONS.c.state)
        query = select(*columns).where(_EVALUATIONS.c.run_id.in_(here))
        there = {tuple(row) for row in self._connection.execute(query)} if here else set()
        rows = []
        for run in runs:
            for entry in run.evaluations:
                keys = (run.snapshot.id, numbers[entry.protocol.fingerprint], entry.state)
                if keys not in there:
                    values = {name: getattr(entry, name) for name in AS_FILED}
                    values |= {"reason": cut(entry.reason, REASON_LENGTH), "engine": cut(entry.engine, _ENGINE_LENGTH)}
                    rows.append({"run_id": keys[0], "protocol_id": keys[1], "open": None, **values})
        if rows:
            self._connection.execute(insert(_EVALUATIONS), rows)
        self._put_figures(runs, here, numbers)
        NoteRepository(self._connection).put({run.snapshot.id: run.notes for run in runs})
        VerdictRepository(self._connection).renew(run.snapshot.id for run in runs)
        DeletedRunRepository(self._connection).forget([run.snapshot.request.uid for run in runs])
        # The ledger keeps queued runs; these have folders.
        changes, filed = changes_of(self._connection), {run.snapshot.id for run in runs}
        changes.runs = [row for row in changes.runs if row.id not in filed]
        return left

    def _put_rows(self, runs: Sequence[FiledRun], here: set[int], protocols: Mapping[str, int]) -> dict[int, int]:
        # {number: number of the original} where the original is neither stored nor filed before its repeat.
        repeats = {run.snapshot.id: run.snapshot.request.retry_of for run in runs}
        wanted = {original for original in repeats.values() if original is not None}
        stored = set(self._column(select(_RUNS.c.id).where(_RUNS.c.id.in_(wanted)))) if wanted else set()
        left = {
            number: original
            for number, original in repeats.items()
            if original is not None and original not in stored and not (original in repeats and original < number)
        }
        rows = []
        requests = SharingRepository(self._connection).of_experiments([run.snapshot.request for run in runs])
        audiences = SharingRepository(self._connection).audiences(requests)
        for run, request in zip(runs, requests, strict=True):
            current = {} if run.current is None else {"current_protocol_id": protocols[run.current]}
            row = {"id": run.snapshot.id, **snapshot_row(replace(run.snapshot, request=request)), **current}
            row["audience"] = audiences[request.uid]
            if run.snapshot.id in here and not run.shared:
                row = {name: value for name, value in row.items() if name not in _SHARED}
            rows.append({**row, "retry_of": None} if run.snapshot.id in left else row)
        new = [row for row in rows if row["id"] not in here]
        if new:
            columns = sorted({name for row in new for name in row})
            self._connection.execute(insert(_RUNS), [{name: row.get(name) for name in columns} for row in new])
        known = sorted((row for row in rows if row["id"] in here), key=sorted)
        for _, alike in groupby(known, key=sorted):
            same = update(_RUNS).where(_RUNS.c.id == bindparam("number"))
            self._connection.execute(same, [{"number": row.pop("id"), **row} for row in alike])
        return left

    def _put_figures(self, runs: Sequence[FiledRun], here: set[int], protocols: Mapping[str, int]) -> None:
        keys = {key for run in runs for values in (run.measured, *run.figures.values()) for key in values}
        metrics = MetricRepository(self._connection).ids(keys)
        rows: list[dict[str, Any]] = []
        for run in runs:
            taken = [(protocols[name], name == run.current, values) for name, values in run.figures.items()]
            for protocol_id, is_current, values in [(MEASURED_PROTOCOL_ID, True, run.measured), *taken]:
                place = {"run_id": run.snapshot.id, "protocol_id": protocol_id, "is_current": int(is_current)}
                rows += [{**place, "metric_id": metrics[key], "value": float(value)} for key, value in values.items()]
        stored = select(_FIGURES.c.run_id).where(_FIGURES.c.run_id.in_(here)).distinct()
        filled = set(self._column(stored)) if here else set()
        number, protocol = _FIGURES.c.run_id == bindparam("number"), _FIGURES.c.protocol_id == bindparam("protocol")
        taken_anew = [
            {"number": run.snapshot.id, "protocol": protocols[fingerprint]}
            for run in runs
            if run.snapshot.id in filled
            for fingerprint in run.figures
        ]
        if taken_anew:
            self._connection.execute(delete(_FIGURES).where(number, protocol), taken_anew)
        measured_anew = [
            {"number": row["run_id"], "protocol": MEASURED_PROTOCOL_ID, "metric": row["metric_id"]}
            for row in rows
            if row["run_id"] in filled and row["protocol_id"] == MEASURED_PROTOCOL_ID
        ]
        if measured_anew:
            one = _FIGURES.c.metric_id == bindparam("metric")
            self._connection.execute(delete(_FIGURES).where(number, protocol, one), measured_anew)
        if rows:
            self._connection.execute(insert(_FIGURES), rows)
        MetricRepository(self._connection).follow_protocols(filled)


# -- imported runs: looked up by their uid, and filed as ended ---------------------------------------------------------

_CHUNK = 100


@dataclass(frozen=True, slots=True)
class ImportedRun:
    """A run to file: ``uid`` identifies trial and trajectory, ``why`` says where it comes from.

    ``protocol``: what it is evaluated under, None for the protocol chosen from its sensors.
    """

    uid: str
    configuration_id: int
    poses: int
    why: str
    dataset_checksum: str
    protocol: Protocol | None = None
    trajectory: TrajectoryKind | None = None


class ImportRepository(Repository):
    """Imported runs have ended when they are filed; no worker ever takes them."""

    def known(self, beginnings: Collection[str]) -> dict[str, int]:
        """{uid: id} of the imported runs whose uid begins with one of ``beginnings`` (hex digits)."""
        found: dict[str, int] = {}
        for part in chunks(sorted(set(beginnings)), _CHUNK):
            spans = [_RUNS.c.uid.between(text, text + "g") for text in part]
            rows = self._connection.execute(
                select(_RUNS.c.uid, _RUNS.c.id).where(or_(*spans), _RUNS.c.executor == IMPORTED)
            )
            found.update((row.uid, row.id) for row in rows)
        return found

    def add(self, runs: Sequence[ImportedRun], now: datetime) -> list[int]:
        """File runs as succeeded; their ids in order. A run whose ``uid`` is stored already is not filed again."""
        requests = [
            RunRequest(
                uid=run.uid,
                configuration_id=run.configuration_id,
                executor=IMPORTED,
                evaluate=True,
                protocol=run.protocol,
            )
            for run in runs
        ]
        ids = RunRepository(self._connection).add_runs(requests, now)
        if ids:
            sealed = [
                {
                    "run": run_id,
                    "to": RunState.SUCCEEDED,
                    "count": run.poses,
                    "text": run.why,
                    "digest": run.dataset_checksum,
                    "kind": run.trajectory,
                }
                for run_id, run in zip(ids, runs, strict=True)
            ]
            row = update(_RUNS).where(_RUNS.c.id == bindparam("run"))
            self._connection.execute(
                row.values(
                    state=bindparam("to"),
                    poses=bindparam("count"),
                    detail=bindparam("text"),
                    dataset_checksum=bindparam("digest"),
                    trajectory=bindparam("kind"),
                ),
                sealed,
            )
            event = update(_EVENTS).where(_EVENTS.c.run_id == bindparam("run"))
            self._connection.execute(event.values(to_state=bindparam("to"), why=bindparam("text")), sealed)
        return ids
