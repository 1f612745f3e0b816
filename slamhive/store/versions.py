"""The versions of packages. A version never changes; its number within the package is never used twice."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import ColumnElement, Row, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from slamhive.store.changes import changes_of
from slamhive.store.models import AlgorithmVersion, Run
from slamhive.store.records import AlgorithmVersion as NewVersion
from slamhive.store.records import VersionRecord
from slamhive.store.rows import Repository

_VERSIONS = AlgorithmVersion.__table__
_FIELDS = tuple(name for name in VersionRecord.__dataclass_fields__ if name != "runs")


class VersionRepository(Repository):
    """Numbers versions, finds them, and notes which of them were removed."""

    def put(self, package: str, version: NewVersion, now: datetime) -> tuple[int, int]:
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
        version = NewVersion(record.identity, record.package_hash, record.version, record.number)
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
        query = select(Run.id, _VERSIONS.c.number).join(_VERSIONS, _VERSIONS.c.id == Run.algorithm_version_id)
        return {row.id: row.number for row in self._connection.execute(query.where(Run.id.in_(run_ids)))}

    def mark_removed(self, package: str, number: int, at: datetime | None) -> None:
        """Note that a version was removed from the engine; None: it is there again."""
        here = (_VERSIONS.c.package == package, _VERSIONS.c.number == number)
        self._connection.execute(update(_VERSIONS).where(*here).values(removed_at=at))
        changes_of(self._connection).catalogue = True

    def _records(self, *conditions: ColumnElement[bool]) -> tuple[VersionRecord, ...]:
        runs = select(func.count()).select_from(Run).where(Run.algorithm_version_id == _VERSIONS.c.id)
        query = select(_VERSIONS, runs.scalar_subquery().label("runs")).where(*conditions)
        rows = self._connection.execute(query.order_by(_VERSIONS.c.package, _VERSIONS.c.number))
        return tuple(_record(row) for row in rows)

    def _find(self, *conditions: ColumnElement[bool]) -> Row[tuple[object, ...]] | None:
        return self._connection.execute(select(_VERSIONS).where(*conditions)).one_or_none()

    def _insert(self, package: str, version: NewVersion, now: datetime) -> None:
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


def _record(row: Row[tuple[object, ...]]) -> VersionRecord:
    return VersionRecord(**{name: getattr(row, name) for name in _FIELDS}, runs=row.runs)
