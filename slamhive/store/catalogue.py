"""Rows that runs refer to: algorithms and their versions, datasets, hosts, protocols; and notes and tags."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, Row, delete, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from slamhive.base.errors import unknown
from slamhive.domain import protocol as domain
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.dataset import Dataset
from slamhive.domain.run import Host, RunNotes
from slamhive.store.changes import changes_of
from slamhive.store.models import (
    AlgorithmRow,
    AlgorithmVersionRow,
    DatasetRow,
    HostRow,
    ProtocolRow,
    RunNoteRow,
    RunRow,
    RunTagRow,
)
from slamhive.store.records import AlgorithmRecord, AlgorithmVersion, DatasetRecord, VersionRecord
from slamhive.store.rows import Repository, chunks, cut, get_or_insert


class CatalogueRepository(Repository):
    """Gets or creates rows, and keeps them equal to the catalogue folders."""

    def put_algorithm(self, algorithm: Algorithm) -> int:
        """The id of ``algorithm``, stored if it is new."""
        return self.put_algorithm_named(algorithm.name, algorithm.package.name, algorithm.mode)

    def put_algorithm_named(self, name: str, package: str, mode: str) -> int:
        """The same for an algorithm whose folder may be gone (reindex)."""
        values = {"package": package, "mode": mode}
        algorithm_id, created = get_or_insert(self._connection, AlgorithmRow, {"name": name}, values)
        changes_of(self._connection).catalogue |= created
        if not created:
            self._connection.execute(
                update(AlgorithmRow.__table__).where(AlgorithmRow.__table__.c.id == algorithm_id).values(values)
            )
        return algorithm_id

    def put_dataset(self, dataset: Dataset, now: datetime, *, gone: bool = False) -> int:
        """The id of ``dataset``. A dataset that was made again under its name replaces what the row says.

        ``gone``: its folder is gone, so the row stays as it is.
        """
        values = {
            "checksum": dataset.checksum,
            "duration_s": dataset.duration_s,
            "folder": str(dataset.folder),
            "title": dataset.title,
            "sensors": [
                {"name": sensor.name, "kind": sensor.kind.value, "topic": sensor.topic, "rate_hz": sensor.rate_hz}
                for sensor in dataset.sensors
            ],
        }
        keys = {"name": dataset.name}
        dataset_id, created = get_or_insert(self._connection, DatasetRow, keys, {**values, "registered_at": now})
        changes_of(self._connection).catalogue |= created
        if not created and not gone:
            self._connection.execute(
                update(DatasetRow.__table__).where(DatasetRow.__table__.c.id == dataset_id).values(values)
            )
        return dataset_id

    def put_host(self, host: Host) -> int:
        """The id of ``host``, stored if it is new."""
        return get_or_insert(self._connection, HostRow, {"fingerprint": host.fingerprint}, asdict(host))[0]

    def put_protocol(self, protocol: domain.Protocol) -> int:
        """The id of ``protocol``, stored if it is new."""
        values = {"label": cut(protocol.label, 255), "definition": protocol.content}
        return get_or_insert(self._connection, ProtocolRow, {"fingerprint": protocol.fingerprint}, values)[0]

    def algorithms(self) -> list[AlgorithmRecord]:
        """All algorithms that the database knows, by name."""
        rows = self._connection.execute(select(AlgorithmRow.__table__).order_by(AlgorithmRow.name))
        return [AlgorithmRecord(row.id, row.name, row.package, row.mode) for row in rows]

    def algorithm(self, name: str) -> AlgorithmRecord:
        """The algorithm called ``name``; raises NotFound."""
        known = {record.name: record for record in self.algorithms()}
        if name not in known:
            raise unknown("algorithm in the database", name, list(known))
        return known[name]

    def datasets(self) -> list[DatasetRecord]:
        """All datasets that the database knows, by name."""
        return [
            _dataset(row) for row in self._connection.execute(select(DatasetRow.__table__).order_by(DatasetRow.name))
        ]

    def dataset(self, name: str) -> DatasetRecord:
        """The dataset called ``name``; raises NotFound."""
        known = {record.name: record for record in self.datasets()}
        if name not in known:
            raise unknown("dataset in the database", name, list(known))
        return known[name]


def _dataset(row: Row[Any]) -> DatasetRecord:
    values = {name: getattr(row, name) for name in DatasetRecord.__dataclass_fields__}
    return DatasetRecord(**{**values, "sensors": tuple(row.sensors)})


# -- versions of packages: a version never changes, and its number is never used twice ---------------------------------

_VERSIONS = AlgorithmVersionRow.__table__
_VERSION = tuple(VersionRecord.__dataclass_fields__)


class VersionRepository(Repository):
    """Numbers versions, finds them, and notes which of them were removed."""

    def put(self, package: str, version: AlgorithmVersion, now: datetime) -> tuple[int, int]:
        """Row and number of a version of ``package``. A new one gets its own number if that is free, else the next.

        A version that was removed and is here again counts as there.
        """
        same = (
            _VERSIONS.c.package == package,
            _VERSIONS.c.identity == version.identity,
            _VERSIONS.c.package_hash == version.package_hash,
        )
        while (found := self._find(*same)) is None:
            self._insert(package, version, now)
        if found.removed_at is not None:
            self.mark_removed(package, found.number, None)
        return found.id, found.number

    def restore(self, record: VersionRecord) -> None:
        """Store a version under its number, unless the version or the number is there already."""
        version = AlgorithmVersion(record.identity, record.package_hash, record.version, record.number)
        _, number = self.put(record.package, version, record.created_at)
        if record.removed_at is not None and number == record.number:
            self.mark_removed(record.package, number, record.removed_at)

    def of(self, package: str) -> tuple[VersionRecord, ...]:
        """All versions of ``package`` with their number of runs, the oldest first."""
        return self._records(_VERSIONS.c.package == package)

    def all(self) -> tuple[VersionRecord, ...]:
        """All versions of all packages with their number of runs, by package, the oldest first."""
        return self._records()

    def of_runs(self, run_ids: list[int]) -> dict[int, int]:
        """{run: number of the version that ran}, without runs that never started."""
        query = select(RunRow.id, _VERSIONS.c.number).join(_VERSIONS, _VERSIONS.c.id == RunRow.algorithm_version_id)
        return {row.id: row.number for row in self._connection.execute(query.where(RunRow.id.in_(run_ids)))}

    def mark_removed(self, package: str, number: int, at: datetime | None) -> None:
        """Note that a version was removed from the engine; None: it is there again."""
        here = (_VERSIONS.c.package == package, _VERSIONS.c.number == number)
        self._connection.execute(update(_VERSIONS).where(*here).values(removed_at=at))
        changes_of(self._connection).catalogue = True

    def _records(self, *conditions: ColumnElement[bool]) -> tuple[VersionRecord, ...]:
        runs = select(func.count()).select_from(RunRow).where(RunRow.algorithm_version_id == _VERSIONS.c.id)
        query = select(_VERSIONS, runs.scalar_subquery().label("runs")).where(*conditions)
        rows = self._connection.execute(query.order_by(_VERSIONS.c.package, _VERSIONS.c.number))
        return tuple(VersionRecord(**{name: getattr(row, name) for name in _VERSION}) for row in rows)

    def _find(self, *conditions: ColumnElement[bool]) -> Row[tuple[object, ...]] | None:
        return self._connection.execute(select(_VERSIONS).where(*conditions)).one_or_none()

    def _insert(self, package: str, version: AlgorithmVersion, now: datetime) -> None:
        """Insert the version, unless another transaction is faster: the caller looks again."""
        own = _VERSIONS.c.package == package
        number = version.number
        if number is None or self._find(own, _VERSIONS.c.number == number) is not None:
            number = 1 + self._number(select(func.coalesce(func.max(_VERSIONS.c.number), 0)).where(own))
        values = {
            "package": package,
            "number": number,
            "identity": version.identity,
            "package_hash": version.package_hash,
            "version": version.version,
            "created_at": now,
        }
        try:
            self._connection.execute(insert(_VERSIONS).values(values))
        except IntegrityError:
            return
        changes_of(self._connection).catalogue = True


# -- notes and tags of runs: the index of what their folders hold ------------------------------------------------------

_NOTES = RunNoteRow.__table__
_TAGS = RunTagRow.__table__


class NoteRepository(Repository):
    """A run without a note has no row, and one row for each of its tags."""

    def put(self, notes: Mapping[int, RunNotes]) -> None:
        """Replace the notes and tags of these runs."""
        for part in chunks(sorted(notes)):
            for table in (_NOTES, _TAGS):
                self._connection.execute(delete(table).where(table.c.run_id.in_(part)))
        texts = [{"run_id": run_id, "note": entry.note} for run_id, entry in notes.items() if entry.note]
        tags = [{"run_id": run_id, "tag": tag} for run_id, entry in notes.items() for tag in entry.tags]
        if texts:
            self._connection.execute(insert(_NOTES), texts)
        if tags:
            self._connection.execute(insert(_TAGS), tags)

    def for_runs(self, run_ids: Iterable[int]) -> dict[int, RunNotes]:
        """{run: notes and tags} of those of these runs that have any."""
        wanted: Sequence[int] = sorted(set(run_ids))
        texts: dict[int, str] = {}
        tags: dict[int, list[str]] = {}
        for part in chunks(wanted):
            texts.update(
                (row.run_id, row.note)
                for row in self._connection.execute(select(_NOTES).where(_NOTES.c.run_id.in_(part)))
            )
            rows = select(_TAGS).where(_TAGS.c.run_id.in_(part)).order_by(_TAGS.c.run_id, _TAGS.c.tag)
            for row in self._connection.execute(rows):
                tags.setdefault(row.run_id, []).append(row.tag)
        return {
            run_id: RunNotes(texts.get(run_id, ""), tuple(tags.get(run_id, ())))
            for run_id in texts.keys() | tags.keys()
        }

    def tags(self) -> list[str]:
        """Every tag that some run has, in order."""
        return self._column(select(_TAGS.c.tag).distinct().order_by(_TAGS.c.tag))
