"""Deleted runs: their rows are removed, and nothing but their files in the trash brings them back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import delete, insert, select, update

from slamhive.store.models import DeletedRun, Evaluation, MetricValue, Run, RunEvent, RunNote, RunTag
from slamhive.store.rows import Repository, chunks
from slamhive.store.verdicts import VerdictRepository

_RUNS = Run.__table__
_DELETED = DeletedRun.__table__
_OF_RUNS = tuple(model.__table__ for model in (MetricValue, Evaluation, RunEvent, RunNote, RunTag))


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
