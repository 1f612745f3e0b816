"""Imported runs: looked up by their uid, and filed as ended."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import bindparam, or_, select, update

from slamhive.domain.external import IMPORTED
from slamhive.domain.protocol import Protocol
from slamhive.domain.run import RunState
from slamhive.domain.trajectory_kind import TrajectoryKind
from slamhive.store.models import Run, RunEvent
from slamhive.store.records import RunRequest
from slamhive.store.rows import Repository, chunks
from slamhive.store.runs import RunRepository

_RUNS = Run.__table__
_EVENTS = RunEvent.__table__
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
