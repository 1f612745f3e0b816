"""What runs refer to: algorithms, datasets, hosts, protocols."""

from __future__ import annotations

from dataclasses import asdict
from datetime import datetime
from typing import Any

from sqlalchemy import Row, select, update

from slamhive.domain import protocol as domain
from slamhive.domain.algorithm import Algorithm as AlgorithmDefinition
from slamhive.domain.dataset import Dataset as DatasetDefinition
from slamhive.domain.host import Host as HostRecord
from slamhive.errors import unknown
from slamhive.store.changes import changes_of
from slamhive.store.models import Algorithm, Dataset, Host, Protocol
from slamhive.store.records import AlgorithmRecord, DatasetRecord
from slamhive.store.rows import Repository, cut, get_or_insert


class CatalogueRepository(Repository):
    """Gets or creates rows, and keeps them equal to the catalogue folders."""

    def put_algorithm(self, algorithm: AlgorithmDefinition) -> int:
        """The id of ``algorithm``, stored if it is new."""
        return self.put_algorithm_named(algorithm.name, algorithm.package.name, algorithm.mode)

    def put_algorithm_named(self, name: str, package: str, mode: str) -> int:
        """The same for an algorithm whose folder may be gone (reindex)."""
        values = {"package": package, "mode": mode}
        algorithm_id, created = get_or_insert(self._connection, Algorithm, {"name": name}, values)
        changes_of(self._connection).catalogue |= created
        if not created:
            self._connection.execute(
                update(Algorithm.__table__).where(Algorithm.__table__.c.id == algorithm_id).values(values)
            )
        return algorithm_id

    def put_dataset(self, dataset: DatasetDefinition, now: datetime, *, gone: bool = False) -> int:
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
        dataset_id, created = get_or_insert(self._connection, Dataset, keys, {**values, "registered_at": now})
        changes_of(self._connection).catalogue |= created
        if not created and not gone:
            self._connection.execute(
                update(Dataset.__table__).where(Dataset.__table__.c.id == dataset_id).values(values)
            )
        return dataset_id

    def put_host(self, host: HostRecord) -> int:
        """The id of ``host``, stored if it is new."""
        return get_or_insert(self._connection, Host, {"fingerprint": host.fingerprint}, asdict(host))[0]

    def put_protocol(self, protocol: domain.Protocol) -> int:
        """The id of ``protocol``, stored if it is new."""
        values = {"label": cut(protocol.label, 255), "definition": protocol.content}
        return get_or_insert(self._connection, Protocol, {"fingerprint": protocol.fingerprint}, values)[0]

    def algorithms(self) -> list[AlgorithmRecord]:
        """All algorithms that the database knows, by name."""
        rows = self._connection.execute(select(Algorithm.__table__).order_by(Algorithm.name))
        return [AlgorithmRecord(row.id, row.name, row.package, row.mode) for row in rows]

    def algorithm(self, name: str) -> AlgorithmRecord:
        """The algorithm called ``name``; raises NotFound."""
        known = {record.name: record for record in self.algorithms()}
        if name not in known:
            raise unknown("algorithm in the database", name, list(known))
        return known[name]

    def datasets(self) -> list[DatasetRecord]:
        """All datasets that the database knows, by name."""
        return [_dataset(row) for row in self._connection.execute(select(Dataset.__table__).order_by(Dataset.name))]

    def dataset(self, name: str) -> DatasetRecord:
        """The dataset called ``name``; raises NotFound."""
        known = {record.name: record for record in self.datasets()}
        if name not in known:
            raise unknown("dataset in the database", name, list(known))
        return known[name]


def _dataset(row: Row[Any]) -> DatasetRecord:
    values = {name: getattr(row, name) for name in DatasetRecord.__dataclass_fields__}
    return DatasetRecord(**{**values, "sensors": tuple(row.sensors)})
